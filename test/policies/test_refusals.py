"""What a robot refuses to run, each for its own reason; whatever it is, the version that was active stays."""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import helper
from policies.models import ACTION, STATE, Aliases, Spark, linear, trained

from shadowhound_data_logger.errors import PolicyError, PolicyRefused
from shadowhound_data_logger.options import StoreSettings, UploadSettings
from shadowhound_data_logger.policies import active, packing, signing, sync
from shadowhound_data_logger.policies.content import check_content
from shadowhound_data_logger.policies.folder import PolicyFolder
from shadowhound_data_logger.policies.manifest import MANIFEST, SIGNATURE, parse_manifest
from shadowhound_data_logger.policies.smoke import run_smoke
from shadowhound_data_logger.policies.sync import PolicySettings, PolicySync
from shadowhound_data_logger.stores import open_store
from shadowhound_data_logger.stores.directory import DirectoryStore


@dataclass
class Scene:
    """A Spark, a store in a folder, a registry, and a robot that trusts the key."""

    path: Path
    registry: Aliases = field(default_factory=Aliases)

    def __post_init__(self) -> None:
        self.spark = Spark(self.path / 'spark')
        self.store = open_store(StoreSettings(directory=self.path / 'store'), UploadSettings())
        self.robot = self.new_robot('thor')
        self.folder = self.robot.folder

    def new_robot(self, name: str, **given: Any) -> PolicySync:
        folder = PolicyFolder(self.path / name)
        folder.make()
        shutil.copy(self.spark.public, folder.path / 'keys' / 'spark.pub')
        settings = PolicySettings(**{'name': 'go2_patrol', 'robot': name, 'min_free_bytes': 0, **given})
        return PolicySync(folder, self.store, self.registry, settings, pause=lambda _: None)

    def place(self, version: int) -> Path:
        return self.path / 'store' / 'lerobot' / 'policies' / 'go2' / f'go2_patrol_v{version}'

    def publish(self, version: int, model: onnx.ModelProto | None = None, alias: str = 'champion', **given: Any) -> str:
        packed, manifest = self.spark.packed(version, model, **given)
        shutil.copytree(packed, self.place(version))
        self.registry.say(alias, version)
        return manifest.id

    def forge(self, version: int, change: Callable[[dict[str, Any]], object]) -> None:
        """A manifest that says something else, well signed."""
        path = self.place(version) / MANIFEST
        told = json.loads(path.read_bytes())
        change(told)
        self.sign(version, json.dumps(told).encode(), self.spark.key)

    def sign(self, version: int, content: bytes, key: Path) -> None:
        (self.place(version) / MANIFEST).write_bytes(content)
        signature = signing.sign(signing.load_key(key), signing.FOR_POLICY, content)
        (self.place(version) / SIGNATURE).write_bytes(signature)

    def refused(self) -> str:
        before = self.folder.current()
        with pytest.raises(PolicyRefused) as raised:
            self.robot.run()
        assert self.folder.current() == before
        return raised.value.reason


@pytest.fixture
def scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Scene]:
    """Its smoke runs go well; those that are about them have their own tests."""
    monkeypatch.setattr(sync, 'run_smoke', lambda *_: 1.0)
    scene = Scene(tmp_path)
    assert isinstance(scene.store, DirectoryStore)
    yield scene
    scene.store.close()


@pytest.fixture
def second(scene: Scene) -> Scene:
    """Version 1 is active, version 2 is published."""
    scene.publish(1)
    assert scene.robot.run().done == 'activated'
    scene.publish(2)
    return scene


@pytest.mark.parametrize('name', ['model.onnx', 'config.json', 'smoke/outputs_0.npy'])
def test_one_flipped_bit_of_a_file(second: Scene, name: str) -> None:
    path = second.place(2) / name
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 4
    path.write_bytes(content)
    assert second.refused() == 'damaged'


@pytest.mark.parametrize('name', [MANIFEST, SIGNATURE])
def test_one_flipped_bit_of_what_is_signed(second: Scene, name: str) -> None:
    path = second.place(2) / name
    content = bytearray(path.read_bytes())
    content[-10] ^= 1
    path.write_bytes(content)
    assert second.refused() == 'signature'


def test_a_wrong_key_in_the_name_of_a_trusted_one(second: Scene) -> None:
    other = Spark(second.path / 'other')
    second.sign(2, content := (second.place(2) / MANIFEST).read_bytes(), other.key)
    told = json.loads((second.place(2) / SIGNATURE).read_bytes())
    (second.place(2) / SIGNATURE).write_text(json.dumps({**told, 'key': second.spark.key_id}))
    assert second.refused() == 'signature'
    second.sign(2, content, second.spark.key)
    assert second.robot.run().done == 'activated'


def test_an_unknown_key(second: Scene) -> None:
    other = Spark(second.path / 'other')
    second.sign(2, (second.place(2) / MANIFEST).read_bytes(), other.key)
    assert second.refused() == 'unknown_key'
    shutil.copy(other.public, second.folder.path / 'keys' / 'other.pub')
    assert second.robot.run().done == 'activated', 'two keys are a rotation'


def test_an_old_serial_that_is_replayed(second: Scene) -> None:
    """A version that this robot never had, older than one that ran; one that it had comes back."""
    second.publish(3)
    assert second.robot.run().done == 'activated'
    second.registry.say('champion', 2)
    assert second.refused() == 'serial'
    second.registry.say('champion', 1)
    assert second.robot.run().active == second.folder.find('go2_patrol@1')


def test_a_revoked_key(second: Scene) -> None:
    """The active version goes as well, for the last one of another key; a list of the revoked key's own counts for nothing."""
    other = Spark(second.path / 'other')
    shutil.copy(other.public, second.folder.path / 'keys' / 'other.pub')
    second.sign(2, (second.place(2) / MANIFEST).read_bytes(), other.key)
    assert second.robot.run().done == 'activated'
    packing.revoke(other.key, [other.key_id], second.store)
    assert second.robot.run().done == 'unchanged'
    packing.revoke(second.spark.key, [other.key_id], second.store)
    result = second.robot.run()
    assert (result.done, result.active) == ('rolled_back', second.folder.find('go2_patrol@1'))
    assert second.refused() == 'revoked'
    packing.revoke(other.key, [second.spark.key_id], second.store)
    assert second.refused() == 'revoked'
    assert second.folder.state().revoked == [other.key_id]


def test_a_list_of_revoked_keys_that_was_exchanged_on_its_way(second: Scene) -> None:
    """Junk in its place hides it for no longer than the junk is there."""
    first = second.folder.current()
    other = Spark(second.path / 'other')
    shutil.copy(other.public, second.folder.path / 'keys' / 'other.pub')
    packing.revoke(other.key, [second.spark.key_id], second.store)
    path = second.path / 'store' / 'lerobot' / packing.revocation_key(1)
    told = path.read_bytes()
    second.registry.say('champion', 1)
    for junk in (b'', b'{}', b'[' * 50_000):
        path.write_bytes(junk)
        assert second.robot.run().active == first
    path.write_bytes(told)
    assert second.robot.run().done == 'rolled_back'


@pytest.mark.parametrize(('path', 'reason'), [
    ('model.pkl', 'file_type'), ('model.pt', 'file_type'), ('run.py', 'file_type'), ('lib.so', 'file_type'),
    ('none', 'file_type'), ('../model.json', 'path'), ('/etc/a.json', 'path'), ('a/../../b.json', 'path'), ('a//b.json', 'path'),
    ('.hidden.json', 'path'),
    ('a\n.json', 'manifest'), ('config.json', 'twice'), ('CONFIG.json', 'twice'), ('manifest.json', 'twice'),
    ('config.json/b.json', 'path'),
])  # fmt: skip
def test_a_manifest_that_names_what_it_may_not(second: Scene, path: str, reason: str) -> None:
    second.forge(2, lambda told: told['files'].append({'path': path, 'bytes': 1, 'sha256': '0' * 64}))
    assert second.refused() == reason


@pytest.mark.parametrize('change', [
    lambda told: told.update(version=2.0), lambda told: told.update(version=True), lambda told: told.update(name='../x'),
    lambda told: told.update(fps=1e400), lambda told: told.pop('limits'), lambda told: told.update(inputs=[]),
    lambda told: told.update(kind='torch'), lambda told: told.update(model='config.json'), lambda told: told.update(files={}),
    lambda told: told['inputs'][0].update(shape=[1 << 20, 1 << 20]), lambda told: told.update(smoke=[]),
])  # fmt: skip
def test_a_manifest_that_is_none(second: Scene, change: Callable[[dict[str, Any]], object]) -> None:
    second.forge(2, change)
    assert second.refused() == 'manifest'


@pytest.mark.parametrize(
    'content', [b'[' * 100_000, b'{"format":1,"format":1}', b'{"format": NaN}', b'1' * 5000, b'\xff', b'', b'[]']
)
def test_a_signed_manifest_of_bad_json(second: Scene, content: bytes) -> None:
    second.sign(2, content, second.spark.key)
    assert second.refused() == 'manifest'


def test_a_manifest_of_two_gigabytes(second: Scene) -> None:
    """It is refused by its size, before a byte of it is read."""
    os.truncate(second.place(2) / MANIFEST, 2 << 30)
    began = time.monotonic()
    assert second.refused() == 'size'
    assert time.monotonic() - began < 5.0


def test_one_for_other_robots(second: Scene) -> None:
    second.forge(2, lambda told: told.update(robot_types=['soarm']))
    assert second.refused() == 'robot_type'


def test_one_too_large_for_the_disk(second: Scene) -> None:
    """For the quota, and for the space that is to be left."""
    for given in ({'max_bytes': 100}, {'min_free_bytes': 1 << 60}):
        robot = second.new_robot('tachi', **given)
        with pytest.raises(PolicyRefused) as raised:
            robot.run()
        assert raised.value.reason == 'disk'


@pytest.mark.parametrize('source', [
    's3://other/policies/go2/go2_patrol_v2', 's3://lerobot/policies/go2/go2_patrol_v1', 'http://x/go2_patrol_v2', '',
    's3://lerobot/policies/go2/../go2/go2_patrol_v2', 's3://lerobot/policies/go2/other_v2', 'file:///etc',
])  # fmt: skip
def test_a_registry_that_names_another_place(second: Scene, source: str) -> None:
    second.registry.say('champion', 2, source=source or '-')
    assert second.refused() == 'source'


def test_another_version_than_the_registry_says(second: Scene) -> None:
    """In the place of version 2 is version 1, well signed."""
    for name in (MANIFEST, SIGNATURE):
        shutil.copy(second.place(1) / name, second.place(2) / name)
    assert second.refused() == 'source'
    second.registry.say('champion', 2, name='other')
    assert second.refused() == 'source'


def test_a_link_in_a_version(second: Scene, tmp_path: Path) -> None:
    """Neither on the robot, whoever put it there, nor on the way into a package."""
    place = second.folder.versions / str(second.folder.current())
    place.chmod(0o700)
    (place / 'config.json').unlink()
    (place / 'config.json').symlink_to('/etc/hostname')
    with pytest.raises(PolicyRefused) as raised, active(second.path / 'thor'):
        pass
    assert raised.value.reason == 'link'
    folder = trained(tmp_path / 'linked')
    (folder / 'more.json').symlink_to('/etc/hostname')
    with pytest.raises(PolicyRefused) as raised:
        packing.pack(folder, folder.with_suffix('.npz'), tmp_path / 'p', packing.Packing(name='a', version=1))
    assert raised.value.reason == 'link'


def test_what_was_verified_is_what_runs(second: Scene) -> None:
    """A file that changed since, one too many, and a link that leads elsewhere."""
    place = second.folder.versions / str(second.folder.current())
    model = place / 'model.onnx'
    model.chmod(0o600)
    content = model.read_bytes()
    model.write_bytes(content[:-1] + b'\0')
    with pytest.raises(PolicyRefused) as raised, active(second.path / 'thor'):
        pass
    assert raised.value.reason == 'damaged'
    model.write_bytes(content)
    with active(second.path / 'thor') as policy:
        assert policy.model == model
    (place / 'more.json').write_text('{}')
    with pytest.raises(PolicyRefused) as raised, active(second.path / 'thor'):
        pass
    assert raised.value.reason == 'files'
    (second.folder.path / 'current').unlink()
    (second.folder.path / 'current').symlink_to('/etc')
    with pytest.raises(PolicyError, match='no policy is active'), active(second.path / 'thor'):
        pass
    (second.folder.path / 'keys').chmod(0o777)
    with pytest.raises(PolicyError, match='others may write'):
        second.robot.run()


def test_data_outside_of_the_model(tmp_path: Path) -> None:
    """Tensors in other files, in any corner of the model, and engines that the runtime would load."""
    path = tmp_path / 'model.onnx'
    whole = linear()
    path.write_bytes(whole.SerializeToString())
    check_content(path, 'model.onnx')
    outside = whole.graph.initializer[0]
    outside.ClearField('raw_data')
    outside.data_location = onnx.TensorProto.EXTERNAL
    entry = outside.external_data.add()
    entry.key, entry.value = 'location', '../../../etc/passwd'
    attribute = helper.make_node('Constant', [], ['c'], value=outside)
    branch = helper.make_graph([attribute], 'branch', [], [])
    nested = helper.make_node('If', ['x'], ['y'], then_branch=branch, else_branch=branch)
    engine = helper.make_node('EPContext', [], ['e'], domain='com.microsoft', ep_cache_context='engine')
    for model in (whole, _of(attribute), _of(nested), _of(engine)):
        path.write_bytes(model.SerializeToString())
        with pytest.raises(PolicyRefused) as raised:
            check_content(path, 'model.onnx')
        assert raised.value.reason == 'external'


def _of(node: onnx.NodeProto) -> onnx.ModelProto:
    return helper.make_model(helper.make_graph([node], 'g', [], []))


@pytest.mark.parametrize(('name', 'content'), [
    ('m.onnx', b'\x80\x04pickle'), ('m.onnx', b''), ('m.onnx', b'\x3a\xff\xff\xff\xff\x7f'), ('m.onnx', b'\x3a\x02' * 40),
    ('m.onnx', b'\xfa\x80\x80\x80\x10\x00'), ('m.safetensors', b'\x80\x04'), ('m.safetensors', b'\xff' * 16),
    ('a.json', b'{'), ('a.json', b'[' * 100_000), ('a.npy', b'\x80\x04'), ('a.npy', b''),
])  # fmt: skip
def test_a_file_that_is_not_what_its_name_says(tmp_path: Path, name: str, content: bytes) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(PolicyRefused) as raised:
        check_content(tmp_path / name, name)
    assert raised.value.reason == 'file_type'


def test_three_robots_one_of_them_the_canary(scene: Scene) -> None:
    """Only the canary takes the new version; an alias of a robot's own comes before both, and its pin before that."""
    robots = {name: scene.new_robot(name) for name in ('thor', 'tachi', 'uro')}
    first = scene.publish(1)
    assert {robot.run().active for robot in robots.values()} == {first}
    second = scene.publish(2, alias='canary')
    scene.registry.say('canary', 2, robots=frozenset({'tachi'}))
    assert [robot.run().active for robot in robots.values()] == [first, second, first]
    third = scene.publish(3, alias='robot-uro')
    assert [robot.run().active for robot in robots.values()] == [first, second, third]
    robots['uro'].folder.use(first)
    assert robots['uro'].run().done == 'pinned'
    scene.registry.say('champion', 2)
    assert [robot.run().active for robot in robots.values()] == [second, second, first]


def test_a_policy_that_misbehaves_is_out_when_its_report_returns(second: Scene) -> None:
    """By what its runner reports; it does not come back though the registry says so, and does by ``use``."""
    first, bad = str(second.folder.current()), str(second.robot.run().active)
    with active(second.path / 'thor') as policy:
        assert all(policy.report(0.01, failed=True) for _ in range(policy.manifest.failures))
        assert not policy.report(0.01, failed=True)
        assert not policy.is_current()
        assert policy.path.is_dir()
    assert second.folder.current() == first
    assert second.refused() == 'bad'
    second.folder.use(bad)
    with active(second.path / 'thor') as policy:
        assert not all(policy.report(6.0) for _ in range(30)), 'it is too slow'
    assert second.folder.current() == first


def test_no_mission_is_disturbed_and_no_version_in_use_removed(second: Scene) -> None:
    """A version waits for the end of a mission; one that somebody uses stays on the disk."""
    first = str(second.folder.current())
    second.robot.may_activate = lambda: False
    assert second.robot.run().done == 'waiting'
    assert second.folder.current() == first
    second.robot.may_activate = lambda: True
    with active(second.path / 'thor') as policy:
        for version in (2, 3, 4, 5):
            if version > 2:
                second.publish(version)
            second.robot.run()
        second.folder.clean(1)
        assert policy.model.is_file()
        assert len(second.folder.installed()) == 3
    assert second.folder.clean(1) == [first]


def test_what_is_there_is_not_fetched_again(second: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine without the runtime of the smoke run downloads a version once, not at each look."""

    def without_runtime(*_: object) -> float:
        raise PolicyError('no runtime')

    fetched: list[str] = []
    content = second.store.content
    monkeypatch.setattr(second.store, 'content', lambda *asked: fetched.append(asked[1]) or content(*asked))
    with monkeypatch.context() as patch:
        patch.setattr(sync, 'run_smoke', without_runtime)
        for _ in range(2):
            with pytest.raises(PolicyError, match='no runtime'):
                second.robot.run()
    assert second.robot.run().done == 'activated'
    assert sum(key.endswith('model.onnx') for key in fetched) == 1


def test_a_full_disk_while_activating_changes_nothing(second: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    before = second.folder.current()

    def full(*_: object) -> None:
        raise OSError(28, 'No space left on device')

    for target in ('symlink_to', 'replace'):
        with monkeypatch.context() as patch:
            patch.setattr(*((Path, target) if target == 'symlink_to' else (os, target)), full)
            with pytest.raises(OSError, match='No space'):
                second.robot.run()
        assert second.folder.current() == before
    assert second.robot.run().done == 'activated'


# -- smoke runs ----------------------------------------------------------------------------------------------------------------


@pytest.mark.long('a process for each run')
def test_the_smoke_run(tmp_path: Path) -> None:
    """No number, another output, too slow and an array of objects, each by a process that runs the model."""
    spark = Spark(tmp_path)
    packed, manifest = spark.packed(1)
    assert run_smoke(packed, manifest) > 0.0
    cases: dict[str, tuple[str, Callable[[dict[str, Any]], object]]] = {
        'output': ('outputs', lambda _: None), 'slow': ('', lambda told: told['limits'].update(p99_ms=1e-6)),
        'pickle': ('inputs', lambda _: None),
    }  # fmt: skip
    for reason, (kind, change) in cases.items():
        folder = tmp_path / reason
        shutil.copytree(packed, folder)
        told = json.loads((folder / MANIFEST).read_bytes())
        change(told)
        (folder / MANIFEST).write_text(json.dumps(told))
        if kind:
            array = np.array([[1.0, 2.0]], 'f4') if kind == 'outputs' else np.array([{}], object)
            np.save(folder / told['smoke'][kind][ACTION if kind == 'outputs' else STATE], array, allow_pickle=True)
        with pytest.raises(PolicyRefused) as raised:
            run_smoke(folder, parse_manifest((folder / MANIFEST).read_bytes()))
        assert raised.value.reason == reason


@pytest.mark.long('a process for each run')
def test_an_output_that_is_no_number(tmp_path: Path) -> None:
    packed, _ = Spark(tmp_path).packed(1)
    (packed / 'model.onnx').write_bytes(linear(float('nan')).SerializeToString())
    with pytest.raises(PolicyRefused) as raised:
        run_smoke(packed, parse_manifest((packed / MANIFEST).read_bytes()))
    assert raised.value.reason == 'nan'
