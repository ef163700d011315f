"""What a robot refuses to run, each for its own reason; whatever it is, the version that was active stays."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import helper, numpy_helper
from policies.models import ACTION, STATE, Scene, Spark, linear, trained

from shadowhound_data_logger.core import durable_files
from shadowhound_data_logger.core.errors import PolicyError, PolicyRefused
from shadowhound_data_logger.policies import active, packing, smoke, sync
from shadowhound_data_logger.policies.content import check_content, check_files
from shadowhound_data_logger.policies.folder import PolicyFolder
from shadowhound_data_logger.policies.manifest import MANIFEST, parse_manifest
from shadowhound_data_logger.policies.smoke import LIMITS, SANDBOX, SmokeRun, run_smoke
from shadowhound_data_logger.policies.state import StateFile
from shadowhound_data_logger.stores.directory import DirectoryStore


@pytest.fixture
def scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Scene]:
    """Its smoke runs go well; those that are about them have their own tests."""
    monkeypatch.setattr(sync, 'run_smoke', lambda *_: SmokeRun(1.0, SANDBOX))
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


def test_one_flipped_bit_of_the_manifest(second: Scene) -> None:
    path = second.place(2) / MANIFEST
    content = bytearray(path.read_bytes())
    content[-10] ^= 1
    path.write_bytes(content)
    assert second.refused() == 'damaged'


def test_an_old_version_that_is_replayed(second: Scene) -> None:
    """A version that this robot never had, older than one that ran; one that it had comes back."""
    second.publish(3)
    assert second.robot.run().done == 'activated'
    second.registry.say('champion', 2)
    assert second.refused() == 'old'
    second.registry.say('champion', 1)
    assert second.robot.run().active == second.folder.versions.find('go2_patrol@1')


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
def test_an_invalid_manifest(second: Scene, change: Callable[[dict[str, Any]], object]) -> None:
    second.forge(2, change)
    assert second.refused() == 'manifest'


@pytest.mark.parametrize(
    'content', [b'[' * 100_000, b'{"format":1,"format":1}', b'{"format": NaN}', b'1' * 5000, b'\xff', b'', b'[]']
)
def test_a_signed_manifest_of_bad_json(second: Scene, content: bytes) -> None:
    second.sign(2, content)
    assert second.refused() == 'manifest'


def test_a_manifest_of_two_gigabytes(second: Scene) -> None:
    """It is refused by its size, and not read as a whole."""
    os.truncate(second.place(2) / MANIFEST, 2 << 30)
    tracemalloc.start()
    try:
        assert second.refused() == 'size'
        assert tracemalloc.get_traced_memory()[1] < 20 << 20
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize('name', [MANIFEST, 'model.onnx', 'config.json'])
def test_one_of_which_a_file_is_not_there(second: Scene, name: str) -> None:
    (second.place(2) / name).unlink()
    assert second.refused() == 'missing'


def test_one_for_other_robots(second: Scene) -> None:
    second.forge(2, lambda told: told.update(robot_types=['soarm']))
    assert second.refused() == 'robot_type'


def test_one_too_large_for_the_disk(second: Scene) -> None:
    """For the quota, and for the space that must stay free."""
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


def test_a_version_that_differs_from_the_registry(second: Scene) -> None:
    """In the place of version 2 is version 1, well signed."""
    second.sign(2, (second.place(1) / MANIFEST).read_bytes())
    assert second.refused() == 'source'
    second.registry.say('champion', 2, name='other')
    assert second.refused() == 'source'


def test_a_link_in_a_version(second: Scene, tmp_path: Path) -> None:
    """Neither on the robot nor when it is packed."""
    place = second.folder.versions.path / str(second.folder.current())
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
    place = second.folder.versions.path / str(second.folder.current())
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
    (second.folder.path / 'metadata').chmod(0o777)
    with pytest.raises(PolicyError, match='other users'):
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
    inside = helper.make_node('Constant', [], ['c'], value=outside)
    branch = helper.make_graph([inside], 'branch', [], [])
    nested = helper.make_node('If', ['x'], ['y'], then_branch=branch, else_branch=branch)
    deeper = helper.make_node('If', ['x'], ['y'], then_branch=helper.make_graph([nested], 'upper', [], []))
    several = helper.make_node('Several', [], [])
    several.attribute.append(onnx.AttributeProto(name='a', type=onnx.AttributeProto.TENSORS, tensors=[outside]))
    several.attribute.append(onnx.AttributeProto(name='b', type=onnx.AttributeProto.GRAPHS, graphs=[branch]))
    engine = helper.make_node('EPContext', [], ['e'], domain='com.microsoft', ep_cache_context='engine')
    sparse = onnx.SparseTensorProto(values=onnx.TensorProto(dims=[1], data_type=1, float_data=[1.0]), indices=outside, dims=[3])
    function = helper.make_function('local', 'f', [], ['c'], [inside], [helper.make_opsetid('', 17)])
    by_attribute = onnx.FunctionProto(name='g', attribute_proto=[onnx.AttributeProto(name='a', t=outside)])
    models = [_of(), *(_of(node) for node in (inside, nested, deeper, several, engine)), *(_of() for _ in range(6))]
    models[0].graph.initializer.append(outside)
    *_, a, b, c, d, e, f = models
    a.graph.sparse_initializer.append(sparse)
    b.functions.append(function)
    c.training_info.add().initialization.CopyFrom(branch)
    d.training_info.add().algorithm.CopyFrom(branch)
    for model, more in ((e, {'sparse_tensor': sparse}), (f, {'sparse_tensors': [sparse]})):
        model.graph.node.add(op_type='Constant').attribute.append(onnx.AttributeProto(name='s', **more))
    models.append(_of())
    models[-1].functions.append(by_attribute)
    for number, model in enumerate(models):
        path.write_bytes(model.SerializeToString())
        with pytest.raises(PolicyRefused) as raised:
            check_content(path, 'model.onnx')
        assert raised.value.reason == 'external', number


def _of(*nodes: onnx.NodeProto) -> onnx.ModelProto:
    return helper.make_model(helper.make_graph(nodes, 'g', [], []))


@pytest.mark.parametrize(('name', 'content'), [
    ('m.onnx', b'\x80\x04pickle'), ('m.onnx', b''), ('m.onnx', b'\x3a\xff\xff\xff\xff\x7f'), ('m.onnx', b'\x3a\x02' * 40),
    ('m.onnx', b'\xfa\x80\x80\x80\x10\x00'),
    ('m.onnx', b'\x12\x80\x08\x00ORTM' + bytes(1024 - 5) + b'\x08\x09'), ('m.safetensors', b'\x80\x04'),
    ('m.safetensors', b'\xff' * 16),
    ('a.json', b'{'), ('a.json', b'[' * 100_000), ('a.npy', b'\x80\x04'), ('a.npy', b''),
])  # fmt: skip
def test_a_file_with_a_wrong_extension(tmp_path: Path, name: str, content: bytes) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(PolicyRefused) as raised:
        check_content(tmp_path / name, name)
    assert raised.value.reason == 'file_type'


def safetensors(header: object, size: int = 8) -> bytes:
    body = header if isinstance(header, bytes) else json.dumps(header).encode()
    return len(body).to_bytes(8, 'little') + body + bytes(size)


@pytest.mark.parametrize('header', [
    {'a': {'dtype': 'F32', 'shape': [2], 'data_offsets': [0, 8]}},
    {'__metadata__': {'format': 'pt'}, 'b': {'dtype': 'F32', 'shape': [], 'data_offsets': [4, 8]},
     'a': {'dtype': 'BF16', 'shape': [1, 2], 'data_offsets': [0, 4]},
     'none': {'dtype': 'U8', 'shape': [0], 'data_offsets': [4, 4]}},
])  # fmt: skip
def test_safetensors_as_the_library_writes_them(tmp_path: Path, header: object) -> None:
    (tmp_path / 'm.safetensors').write_bytes(safetensors(header))
    check_content(tmp_path / 'm.safetensors', 'm.safetensors')


@pytest.mark.parametrize('header', [
    b'[]', b'{}', b'null', b'{"a": NaN}', b'{"a": {"dtype": "F32", "shape": [2], "data_offsets": [0, 8]}, "a": {}}',
    b'[' * 100_000,
    {'a': {'dtype': 'F32', 'shape': [2]}},
    {'a': {'dtype': 'object', 'shape': [1], 'data_offsets': [0, 8]}}, {'a': {'dtype': 'F32', 'shape': 2, 'data_offsets': [0, 8]}},
    {'a': {'dtype': 'F32', 'shape': [-1, -2], 'data_offsets': [0, 8]}},
    {'a': {'dtype': 'F32', 'shape': [2.0], 'data_offsets': [0, 8]}},
    {'a': {'dtype': 'F32', 'shape': [3], 'data_offsets': [0, 8]}},
    {'a': {'dtype': 'F32', 'shape': [1], 'data_offsets': [4, 8]}}, {'a': {'dtype': 'F32', 'shape': [1], 'data_offsets': [0, 4]}},
    {'a': {'dtype': 'F32', 'shape': [4], 'data_offsets': [0, 16]}}, {'a': {'dtype': 'F32', 'shape': [2], 'data_offsets': [8, 0]}},
    {'a': {'dtype': 'F32', 'shape': [2], 'data_offsets': [0, 8]}, 'b': {'dtype': 'F32', 'shape': [1], 'data_offsets': [4, 8]}},
    {'a': {'dtype': 'F32', 'shape': [1], 'data_offsets': [0, 4]}, 'b': {'dtype': 'U8', 'shape': [2], 'data_offsets': [6, 8]}},
    {'a': {'dtype': 'F32', 'shape': [2], 'data_offsets': [0, 8]}, '__metadata__': {'a': 1}},
    {'a': {'dtype': 'F32', 'shape': [2], 'data_offsets': [False, 8]}},
    {'a': {'dtype': 'U8', 'shape': [1 << 62, 4, 1 << 62, 0], 'data_offsets': [0, 8]}},
    json.dumps({'a': {'dtype': 'F32', 'shape': [2], 'data_offsets': [0, 8]}}).encode() + b' ' * (2 << 20),
])  # fmt: skip
def test_invalid_safetensors(tmp_path: Path, header: object) -> None:
    """Another type, shape or place of a tensor than the format allows, overlaps and gaps, or a header of megabytes."""
    (tmp_path / 'm.safetensors').write_bytes(safetensors(header))
    with pytest.raises(PolicyRefused) as raised:
        check_content(tmp_path / 'm.safetensors', 'm.safetensors')
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
    """A version waits for the end of a mission; a version in use stays on disk."""
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
        assert len(second.folder.versions.ids()) == 3
    assert second.folder.clean(1) == [first]


@pytest.mark.parametrize('verb', ['pin', 'use'])
def test_a_pin_holds_though_another_version_was_on_its_way(second: Scene, monkeypatch: pytest.MonkeyPatch, verb: str) -> None:
    """Who pins within a download finds that version active after it, and not for one look the other one."""
    first = str(second.folder.current())

    def pins(*_: object) -> SmokeRun:
        second.folder.pin() if verb == 'pin' else second.folder.use(first)
        return SmokeRun(1.0, SANDBOX)

    monkeypatch.setattr(sync, 'run_smoke', pins)
    result = second.robot.run()
    assert (result.done, result.wanted, result.active) == ('pinned', first, first)
    assert second.folder.current() == first
    second.folder.unpin()
    assert second.robot.run().done == 'activated'


def test_what_is_there_is_not_fetched_again(second: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine without the runtime of the smoke run downloads a version once, not at each look."""

    def without_runtime(*_: object) -> SmokeRun:
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


def test_a_pinned_version_waits_for_the_end_of_a_mission_too(second: Scene) -> None:
    """Where its activation was cut off before."""
    first, later = second.folder.versions.find('go2_patrol@1'), str(second.robot.run().active)
    with second.folder.state.changing() as state:
        state.pin = first
    second.robot.may_activate = lambda: False
    assert second.robot.run() == sync.SyncResult(first, later, 'waiting', isolation='sandbox')
    assert second.folder.current() == later
    second.robot.may_activate = lambda: True
    assert second.robot.run().active == first


@pytest.mark.parametrize('name', ['metadata', 'versions', 'incoming', 'root.json', ''])
def test_a_folder_or_a_root_that_others_may_write(second: Scene, name: str) -> None:
    """Neither what is active nor what is there is believed then; nor where it belongs to another user, or is a link."""
    place = second.folder.path / name

    def is_refused() -> None:
        with pytest.raises(PolicyError, match='other users'):
            second.robot.run()
        with pytest.raises(PolicyError, match='other users'), active(second.path / 'thor'):
            pass

    mode = place.stat().st_mode
    for more in (0o020, 0o002):
        place.chmod(mode | more)
        is_refused()
    place.chmod(mode)
    if os.getuid() == 0:
        os.chown(place, 65534, -1)
        is_refused()
        os.chown(place, 0, -1)
    assert second.robot.run().done == 'activated'
    place.rename(second.path / 'elsewhere')
    place.symlink_to(second.path / 'elsewhere')
    is_refused()


def test_no_rollback_waits_for_gigabytes(second: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither while their hashes are checked nor while they are removed is the lock held that it needs."""
    for version in (3, 4):
        second.robot.run()
        second.publish(version)
    held: list[bool] = []

    def asks(act: Callable[..., object]) -> Callable[..., object]:
        def acts(*given: Any, **named: Any) -> object:
            if named.get('hashes', True):
                with durable_files.flock(second.folder.path / 'lock', wait=False) as is_free:
                    held.append(not is_free)
            return act(*given, **named)

        return acts

    monkeypatch.setattr('shadowhound_data_logger.policies.versions.check_files', asks(check_files))
    monkeypatch.setattr('shadowhound_data_logger.policies.versions.shutil.rmtree', asks(shutil.rmtree))
    second.robot.settings = replace(second.robot.settings, keep=2)
    assert second.robot.run().done == 'activated'
    second.folder.use(second.folder.versions.find('go2_patrol@3'))
    assert len(held) == 4
    assert not any(held)


def test_a_home_that_others_can_write_to(second: Scene) -> None:
    """He could put other keys into the place of ours; where only owners may rename, as in /tmp, he cannot."""
    home = second.path / 'thor'
    home.chmod(0o1777)
    assert second.robot.run().done == 'activated'
    home.chmod(0o777)
    with pytest.raises(PolicyError, match='other users'):
        second.robot.run()
    with pytest.raises(PolicyError, match='other users'), active(home):
        pass


@pytest.mark.parametrize('name', ['stray', 'link', '{id}', '{id}/link.json', '{id}/stray', '{id}/smoke', '{id}/model.onnx.part/'])
def test_stray_files_do_not_disturb_downloads(second: Scene, name: str) -> None:
    """Foreign files, links and folders are deleted, and the download continues."""
    manifest = parse_manifest((second.place(2) / MANIFEST).read_bytes())
    place = second.folder.versions.incoming / name.format(id=manifest.id)
    place.parent.mkdir(exist_ok=True)
    if 'link' in name:
        place.symlink_to(second.path)
    elif name.endswith('/'):
        place.mkdir()
    else:
        place.write_bytes(b'stray')
    assert second.robot.run().done == 'activated'
    assert list(second.folder.versions.incoming.iterdir()) == []


def test_a_rollback_that_is_cut_off_is_ended_by_the_next(second: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """The next rollback or sync finishes it: to the last good version, not to one before it."""
    first, bad = str(second.folder.current()), str(second.robot.run().active)
    for end in (second.folder.roll_back, second.robot.run):
        with monkeypatch.context() as patch:
            patch.setattr(PolicyFolder, '_link', lambda *_: 1 / 0)
            with pytest.raises(ZeroDivisionError):
                second.folder.roll_back()
        assert second.folder.current() == bad
        second.registry.say('champion', 1)
        end()
        assert second.folder.current() == first
        second.folder.use(bad)
        second.folder.unpin()


def test_one_that_is_too_large_for_the_quota_costs_no_other(second: Scene) -> None:
    """Nothing is removed for what has no room even then."""
    second.robot.run()
    second.publish(3)
    second.robot.run()
    second.publish(4)
    second.robot.settings = replace(second.robot.settings, max_bytes=100)
    assert second.refused() == 'disk'
    assert len(second.folder.versions.ids()) == 3


def test_a_policy_goes_out_though_the_disk_is_full(second: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is reported; because it could not be recorded, the policy may be activated again when there is free space."""
    first, bad = second.folder.current(), second.robot.run().active

    def full(*_: object) -> None:
        raise OSError(28, 'No space left on device')

    with active(second.path / 'thor') as policy, monkeypatch.context() as patch:
        patch.setattr(StateFile, 'write', full)
        with pytest.raises(OSError, match='No space'):
            all(policy.report(100.0) for _ in range(30))
        assert second.folder.current() == first
    assert second.robot.run().active == bad


# -- smoke runs ----------------------------------------------------------------------------------------------------------------


def greedy() -> onnx.ModelProto:
    """It wants 32 GiB before it says anything."""
    model = linear()
    model.graph.initializer.append(numpy_helper.from_array(np.array([1 << 33]), 'size'))
    model.graph.node[0].output[0] = 'half'
    model.graph.node.extend([
        helper.make_node('ConstantOfShape', ['size'], ['zeros']), helper.make_node('ReduceMax', ['zeros'], ['zero'], keepdims=0),
        helper.make_node('Add', ['half', 'zero'], [ACTION]),
    ])  # fmt: skip
    return model


@pytest.mark.long('a process for each run')
@pytest.mark.parametrize(('reason', 'change'), [
    ('', {}), ('output', {'outputs': np.array([[1.0, 2.0]], 'f4')}), ('pickle', {'inputs': np.array([{}], object)}),
    ('inputs', {'inputs': np.zeros((1, 4), 'f4')}), ('nan', {'model': linear(float('nan'))}),
    ('nan', {'model': linear(float('inf'))}), ('memory', {'model': greedy()}), ('smoke', {'model': linear(operator='Nonsense')}),
    ('slow', {'p99_ms': 1e-6}),
])  # fmt: skip
def test_the_smoke_run(tmp_path: Path, reason: str, change: dict[str, Any]) -> None:
    """What does not give what was promised, is too slow, or does not run at all; each by a process that runs the model."""
    packed, _ = Spark(tmp_path).packed(1)
    told = json.loads((packed / MANIFEST).read_bytes())
    for kind, name in (('inputs', STATE), ('outputs', ACTION)):
        if kind in change:
            np.save(packed / told['smoke'][kind][name], change[kind], allow_pickle=True)
    if 'model' in change:
        (packed / 'model.onnx').write_bytes(change['model'].SerializeToString())
    told['limits']['p99_ms'] = change.get('p99_ms', 5000.0)
    (packed / MANIFEST).write_text(json.dumps(told))
    manifest = parse_manifest((packed / MANIFEST).read_bytes())
    if not reason:
        assert run_smoke(packed, manifest, LIMITS).p99_ms > 0.0
        return
    with pytest.raises(PolicyRefused) as raised:
        run_smoke(packed, manifest, LIMITS)
    assert raised.value.reason == reason


def test_a_smoke_run_that_crashes_or_does_not_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    packed, manifest = Spark(tmp_path).packed(1)
    with pytest.raises(PolicyRefused) as raised:
        run_smoke(packed, manifest, LIMITS, limit_s=0.0)
    assert raised.value.reason == 'time'
    for told in ((b'', -11), (b'[' * 100_000, 0), (b'{"reason": ""}', 1), (b'\xff' * 70_000, -9)):
        monkeypatch.setattr(smoke, '_run_child', lambda *_, told=told: told)
        with pytest.raises(PolicyRefused) as raised:
            run_smoke(packed, manifest, LIMITS)
        assert raised.value.reason == 'smoke'


def test_each_reason_is_explained_and_tested() -> None:
    """The list in docs/policies.md has those that the code has, and each of them has a test."""
    root = Path(__file__).parents[2]
    code = ''.join(path.read_text() for path in (root / 'shadowhound_data_logger/policies').glob('*.py'))
    page = (root / 'docs/policies.md').read_text()
    listed = page[page.index('### Why a version is refused') : page.index('The smoke run is')]
    explained = {reason for line in re.findall(r'^- (`.*?): ', listed, re.MULTILINE) for reason in re.findall(r'\w+', line)}
    raised = {*re.findall(r"PolicyRefused\(\s*'(\w+)'", code), *smoke._REASONS} - {'revocation', 'runtime'}  # of no policy
    assert raised <= explained <= {*re.findall(r"'(\w+)'", code)}
    tests = ''.join(path.read_text() for path in Path(__file__).parent.glob('test_*.py'))
    assert [reason for reason in explained if not re.search(rf"(== |\(|, )'{reason}'", tests)] == []


CONFINED = """
import os, sys
from shadowhound_data_logger.policies import smoke
if os.getuid() == 0:  # whom no limit of processes holds
    os.setgroups([])
    os.setgid(65534)
    os.setuid(65534)
smoke._confine()
said = []
for what in (os.fork, lambda: os.write(os.open('file', os.O_WRONLY | os.O_CREAT, 0o600), b'x' * 100)):
    try:
        what()
        said.append('done')
    except OSError as error:
        said.append(error.strerror)
print(said)
"""


def test_the_smoke_run_starts_nothing_and_writes_nothing() -> None:
    """It can start no process, and write no byte to any file."""
    environ = {'PYTHONPATH': os.pathsep.join(path for path in sys.path if path), 'PYTHONDONTWRITEBYTECODE': '1'}
    with tempfile.TemporaryDirectory() as folder:
        Path(folder).chmod(0o777)
        command = [sys.executable, '-c', CONFINED]
        done = subprocess.run(command, cwd=folder, env=environ, check=True, capture_output=True, text=True)
    assert done.stdout == "['Resource temporarily unavailable', 'File too large']\n"


@pytest.mark.long('a process of its own')
@pytest.mark.skipif(os.getuid() != 0, reason='the other tests of smoke runs are those of an ordinary user')
def test_the_smoke_run_of_an_ordinary_user(tmp_path: Path) -> None:
    """The runtime needs no additional process or thread: a user other than root can have none there."""
    packed, _ = Spark(tmp_path).packed(1)
    rights = '=-all,+dac_override,+dac_read_search'  # to read Python's own files, wherever they are
    program = 'from shadowhound_data_logger.policies import smoke; smoke.main()'
    command = ['setpriv', '--reuid=65534', '--clear-groups', f'--inh-caps{rights}', f'--ambient-caps{rights}',
               f'--bounding-set{rights}', sys.executable, '-B', '-c', program, str(packed)]  # fmt: skip
    environ = smoke.environ_of(str(tmp_path))
    done = subprocess.run(command, cwd=tmp_path, env=environ, check=True, capture_output=True)
    assert json.loads(done.stdout)['reason'] == ''


STARTS = """
import os, sys, time
inside, outside = os.pipe()
if os.fork():
    os.read(inside, 1)
    while True:
        os.write(1, b'x' * 9999)
open(sys.argv[1], 'w').write(str(os.getpid()))
os.write(outside, b'x')
time.sleep(600)
"""


def test_what_the_smoke_run_started_ends_with_it(tmp_path: Path) -> None:
    """With a bound of what is read of it, and of its time."""

    def run(program: str, limit_s: float = 600.0) -> tuple[bytes, int | None]:
        return smoke._run_child([sys.executable, '-c', program, str(tmp_path / 'pid')], os.environ, str(tmp_path), limit_s)

    told, _ = run(STARTS)
    assert len(told) <= 2 * smoke.MAX_ANSWER_BYTES
    assert gone(int((tmp_path / 'pid').read_text()))
    assert run('print(1)') == (b'1\n', 0)
    assert run('import os; os.abort()') == (b'', -6)
    assert run('import time; time.sleep(600)', 0.1) == (b'', None)


def gone(pid: int) -> bool:
    """Waits for its end."""
    end = time.monotonic() + 60.0
    while time.monotonic() < end:
        with suppress(OSError):
            if Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()[0] != 'Z':
                time.sleep(0.01)
                continue
        return True
    return False


@pytest.mark.long('a process of its own')
def test_the_smoke_run_takes_no_package_from_the_current_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Otherwise users who can write there could run code."""
    packed, manifest = Spark(tmp_path).packed(1)
    (tmp_path / 'here').mkdir()
    (tmp_path / 'here' / 'onnxruntime.py').write_text("raise RuntimeError('from here')")
    monkeypatch.chdir(tmp_path / 'here')
    monkeypatch.setattr(sys, 'path', ['', *sys.path])
    assert run_smoke(packed, manifest, LIMITS).p99_ms > 0.0
