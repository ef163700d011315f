"""MkDocs hook: files of the repository that pages link to (``../launch_configs/go2.yaml``) are pages of the site too."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, InclusionLevel

ROOT = Path(__file__).resolve().parents[1]
LINK = re.compile(r'\]\((?:\.\./)+((?!docs/)[^)#]+\.(?:cff|py|rst|service|yaml|yml|xml))\)')


def on_files(files: Any, config: Any) -> Any:
    """Add a page for each of these files, with its content as code."""
    pages = [Path(file.abs_src_path) for file in files.documentation_pages()]
    for name in sorted({name for page in pages for name in LINK.findall(page.read_text(encoding='utf-8'))}):
        content = (ROOT / name).read_text(encoding='utf-8')
        language = {'.py': 'python', '.service': 'ini', '.yaml': 'yaml', '.yml': 'yaml'}.get(Path(name).suffix, '')
        text = f'---\nsearch: {{exclude: true}}\n---\n# {name}\n\n````{language}\n{content}\n````\n'
        files.append(File.generated(config, f'files/{name}.md', content=text, inclusion=InclusionLevel.NOT_IN_NAV))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Let links to these files lead to their pages, and let a search find records of the past last."""
    if page.file.src_uri.startswith(('decisions/', 'evidence/')):
        page.meta['search'] = {'boost': 0.1}
    up = '../' * page.file.src_uri.count('/')
    return LINK.sub(lambda found: f']({up}files/{found[1]}.md)', markdown)
