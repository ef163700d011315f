"""What a hostile robot writes into its runs, in the browser of whoever looks at MLflow's pages as Spark."""

from __future__ import annotations

import asyncio
import json
import shutil
from collections.abc import Iterator
from typing import Any

import pytest
from shadowhound_tower.embedded import Tower
from tower.test_mlflow_access import User, _artifact

CHROMIUM = shutil.which('chromium') or shutil.which('chromium-browser') or shutil.which('google-chrome')
pytestmark = pytest.mark.seaweedfs
EVIL = (
    '<img src=x onerror="window.top.pwned=1"><script>window.pwned=1</script>"\'><svg onload="window.pwned=1">'
    '[x](javascript:pwned=1)'
)
NOTE = (
    f'{EVIL}\n\n<iframe src="javascript:top.pwned=1"></iframe>\n\n[click](javascript:alert(1)) '
    '<a href="javascript:alert(1)">here</a>'
)
TAGS = {
    'mlflow.note.content': NOTE, 'mlflow.runName': EVIL, 'mlflow.user': EVIL, 'mlflow.source.name': 'javascript:alert(1)',
    'mlflow.source.type': 'PROJECT', 'mlflow.source.git.repoURL': 'javascript:alert(1)', 'mlflow.source.git.commit': EVIL,
    'mlflow.source.git.branch': EVIL, 'mlflow.project.entryPoint': EVIL, 'mlflow.gitRepoURL': 'javascript:alert(1)',
    'mlflow.databricks.notebookURL': 'javascript:alert(1)', 'mlflow.datasets': EVIL, 'policy': EVIL,
    'mlflow.loggedArtifacts': json.dumps([{'path': EVIL, 'type': 'table'}]),
    'mlflow.log-model.history': json.dumps([{'artifact_path': EVIL, 'run_id': 'x', 'flavors': {EVIL: {}}, 'model_uuid': EVIL}]),
}  # fmt: skip
SANDBOXES = 'all => all.map(one => one.getAttribute("sandbox"))'
LOOK_MS = 1500
"""For whatever a page shows to run, after it is shown."""
PAGE = b"""<html><body><script>
try { window.top.pwned = 1 } catch (error) {}
fetch('/ajax-api/2.0/mlflow/users/current').then(answer => { document.title = 'read ' + answer.status; alert('read') })
</script></body></html>"""
SVG = b'<svg xmlns="http://www.w3.org/2000/svg"><script>window.top.pwned=1;alert(1)</script></svg>'
ARTIFACTS = {
    'a.html': PAGE, 'a.htm': PAGE, 'a.svg': SVG, 'a.md': NOTE.encode(), 'a.txt': NOTE.encode(), 'a.csv': EVIL.encode(),
    'a.json': json.dumps({EVIL: EVIL}).encode(), 'table.json': json.dumps({'columns': [EVIL], 'data': [[EVIL]]}).encode(),
    'a.xhtml': b'<html xmlns="http://www.w3.org/1999/xhtml"><script>window.top.pwned=1</script></html>',
    'a.jpg': PAGE, 'none': PAGE,
    'a.geojson': json.dumps({'type': 'Feature', 'properties': {'popupContent': EVIL},
                             'geometry': {'type': 'Point', 'coordinates': [1, 1]}}).encode(),
}  # fmt: skip


@pytest.fixture(scope='module')
def run(tower: Tower) -> Iterator[dict[str, Any]]:
    """One of thor's, with whatever a robot can write."""
    thor = User(tower, 'thor')
    experiment = thor.experiment('thor_missions')
    made = thor.run(experiment)
    for key, value in TAGS.items():
        thor.call('POST', 'runs/set-tag', {'run_id': made['run_id'], 'key': key, 'value': value})
    note = {'experiment_id': experiment, 'key': 'mlflow.note.content', 'value': NOTE}
    thor.call('POST', 'experiments/set-experiment-tag', note)
    thor.call('POST', 'runs/log-batch', {'run_id': made['run_id'], 'params': [{'key': 'p', 'value': EVIL}]})
    for name, body in ARTIFACTS.items():
        assert thor.status('PUT', _artifact(made, name), body) == 200
    yield made
    thor.http.clear()


@pytest.mark.parametrize('name', ARTIFACTS)
def test_no_artifact_is_shown_as_a_page_of_the_server(tower: Tower, run: dict[str, Any], name: str) -> None:
    """Wherever a robot's artifact is handed out, browsers store it, and guess no type of it."""
    spark = User(tower, 'spark')
    places = [_artifact(run, name), _artifact(run, name).replace('/api/', '/ajax-api/', 1)]
    for path in (*places, f'/get-artifact?path={name}&run_uuid={run["run_id"]}'):
        answer = spark.send('GET', path)
        assert answer.status == 200
        assert answer.headers['Content-Disposition'].startswith('attachment')
        assert answer.headers['X-Content-Type-Options'] == 'nosniff'
    spark.http.clear()


@pytest.mark.long('a browser that looks at a dozen pages')
@pytest.mark.skipif(CHROMIUM is None, reason='no Chromium is installed here: apt install chromium')
def test_no_script_of_a_robot_runs_in_mlflows_pages(tower: Tower, run: dict[str, Any]) -> None:
    """Tags, notes, params and artifacts are shown: none opens a dialog, is a link that runs, or gets hold of the page."""
    password = tower.tracking('spark')['MLFLOW_TRACKING_PASSWORD']
    place = f'/#/experiments/{run["experiment_id"]}'
    pages = [place, f'{place}/runs', f'{place}/runs/{run["run_id"]}',
             *(f'{place}/runs/{run["run_id"]}/artifacts/{name}' for name in ARTIFACTS)]  # fmt: skip

    expected = {path: path.rpartition('/')[2] if '/artifacts/' in path else 'Model training' for path in pages}

    async def poll() -> dict[str, Any]:
        from playwright.async_api import async_playwright

        found: dict[str, Any] = {}
        async with async_playwright() as playwright:
            browser = await playwright.chromium.launch(executable_path=CHROMIUM, args=['--no-sandbox', '--disable-gpu'])
            context = await browser.new_context(http_credentials={'username': 'spark', 'password': password})
            for path in pages:
                page, dialogs = await context.new_page(), list[str]()
                page.on('dialog', lambda dialog, dialogs=dialogs: (dialogs.append(dialog.message), dialog.dismiss())[1])
                await page.goto(tower.tracking_uri + path)
                await page.wait_for_function('expected => document.body.innerText.includes(expected)', arg=expected[path])
                if path.endswith('.html'):
                    await page.locator('iframe[src^="blob:"]').wait_for(state='attached')
                await page.wait_for_timeout(LOOK_MS)
                found[path] = {
                    'dialogs': dialogs, 'pwned': await page.evaluate('window.pwned'),
                    'links': await page.locator('a[href^="javascript:" i], iframe[src^="javascript:" i]').count(),
                    'frames': await page.eval_on_selector_all('iframe[src]', SANDBOXES),
                }  # fmt: skip
                await page.close()
            await browser.close()
        return found

    found = asyncio.run(poll())
    assert len(found) == len(pages)
    assert {path: each for path, each in found.items() if each['dialogs'] or each['pwned'] or each['links']} == {}
    frames = [sandbox for each in found.values() for sandbox in each['frames']]
    assert 'allow-scripts' in frames  # the HTML page, in an origin of its own
    assert set(frames) <= {'allow-scripts'}
