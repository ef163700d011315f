"""Run by lerobot's own Python: reads datasets offline, with no socket, and writes what lerobot makes of them.

``load OUT.npz FOLDER`` has every frame of it; ``merge OUT FOLDER FOLDER`` merges two; ``read OUT.json FOLDER`` reads it in every
way and says how many frames differ from those by index; ``tools OUT FOLDER`` makes a set by each of lerobot's tools; ``view OUT
FOLDER`` writes what lerobot-dataset-viz shows; ``arm OUT`` makes datasets of an arm as lerobot records and edits them.
"""

from __future__ import annotations

import json
import os
import shutil
import socket
import sys
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

os.environ |= {'HF_HUB_OFFLINE': '1', 'HF_DATASETS_OFFLINE': '1', 'TOKENIZERS_PARALLELISM': 'false'}


def refused(method: Callable[..., Any]) -> Callable[..., Any]:
    def connect(self: socket.socket, *arguments: Any) -> Any:
        if self.family != socket.AF_UNIX:  # the workers of a DataLoader pass memory through it
            raise OSError('this test has no network')
        return method(self, *arguments)

    return connect


for name in ('connect', 'connect_ex'):
    setattr(socket.socket, name, refused(getattr(socket.socket, name)))

import numpy as np  # noqa: E402
from lerobot.configs.video import RGBEncoderConfig  # noqa: E402
from lerobot.datasets import dataset_tools as tools  # noqa: E402
from lerobot.datasets.aggregate import aggregate_datasets  # noqa: E402
from lerobot.datasets.lerobot_dataset import LeRobotDataset  # noqa: E402
from lerobot.datasets.streaming_dataset import StreamingLeRobotDataset  # noqa: E402
from lerobot.utils.feature_utils import dataset_to_policy_features  # noqa: E402
from torch.utils.data import DataLoader  # noqa: E402

CAMERA = 'observation.images.front'
ARM_FPS, JOINTS = 10, ('shoulder.pos', 'elbow.pos')


def opened(folder: str | Path, **how: Any) -> LeRobotDataset:
    return LeRobotDataset('local/set', root=folder, **how)


def delta_of(fps: int) -> dict[str, list[float]]:
    return {'action': [0.0, 1 / fps, 2 / fps], CAMERA: [-1 / fps, 0.0], 'observation.state': [-1 / fps, 0.0]}


def load(out: str, folder: str) -> None:
    plain = opened(folder)
    found: dict[str, list[object]] = {}
    for number in range(len(plain)):
        for name, value in plain[number].items():
            found.setdefault(name, []).append(value if isinstance(value, str) else np.asarray(value))
    windows = opened(folder, delta_timestamps=delta_of(plain.fps))
    batches = DataLoader(windows, batch_size=16, shuffle=False)
    actions = [np.asarray(batch['action']) for batch in batches]
    kinds = {name: feature.type.value for name, feature in dataset_to_policy_features(plain.meta.features).items()}
    fields = {name: np.array(values) for name, values in found.items() if name != CAMERA}
    images = (np.array(found[CAMERA]) * 255).round().astype(np.uint8)
    np.savez(out, pictures=images.transpose(0, 2, 3, 1), windows=np.concatenate(actions), episodes=plain.num_episodes,
             kinds=np.array([f'{name}={kind}' for name, kind in kinds.items()]), **fields)  # fmt: skip


def merge(out: str, *folders: str) -> None:
    aggregate_datasets([f'local/{number}' for number in range(len(folders))], 'local/all', roots=[Path(each) for each in folders],
                       aggr_root=Path(out))  # fmt: skip


# -- every way to read -----------------------------------------------------------------------------------------------------


def read(out: str, folder: str) -> None:
    """Which frames are read in each way, and which of them are not those by index; or the error."""
    wanted = opened(folder, video_backend='pyav')
    frames = [wanted[number] for number in range(len(wanted))]
    bounds = [(row['dataset_from_index'], row['dataset_to_index']) for row in wanted.meta.episodes]
    fields = {}
    for backend in ('torchcodec', 'pyav'):
        plain = opened(folder, video_backend=backend)
        fields[f'index {backend}'] = compared((plain[number] for number in range(len(plain))), frames)
        windows = opened(folder, video_backend=backend, delta_timestamps=delta_of(plain.fps))
        loader = DataLoader(windows, batch_size=None, shuffle=False, num_workers=2)
        fields[f'delta {backend}'] = compared(loader, frames, bounds)
    for name, how in {'streamed': {}, 'streamed delta': {'delta_timestamps': {CAMERA: [-1 / wanted.fps, 0.0]}}}.items():
        stream = StreamingLeRobotDataset('local/set', root=folder, shuffle=False, buffer_size=8, **how)
        fields[name] = compared(stream, frames, bounds if how else None)
    Path(out).write_text(json.dumps(fields))


def compared(found: Iterable[Mapping[str, Any]], frames: list[Mapping[str, Any]], bounds: Any = None) -> dict[str, Any]:
    """``bounds`` of the episodes for what has windows: [-1, 0] of pictures and states, [0, 1, 2] of actions, held at the ends."""
    seen, wrong = [], []
    try:
        for item in found:
            index = int(item['index'])
            seen.append(index)
            if not all(is_same(name, value, index, frames, bounds) for name, value in item.items()):
                wrong.append(index)
    except Exception as error:  # noqa: BLE001 - the error that lerobot raises is the result
        return {'seen': len(seen), 'wrong': wrong, 'error': f'{type(error).__name__}: {error}'[:300]}
    return {'seen': len(set(seen)), 'wrong': wrong, 'error': ''}


def is_same(name: str, value: Any, index: int, frames: list[Mapping[str, Any]], bounds: Any) -> bool:
    if name.endswith('_is_pad'):
        return True
    if isinstance(value, str):
        return bool(value == frames[index][name])
    got = np.asarray(value)
    steps = {CAMERA: (-1, 0), 'observation.state': (-1, 0), 'action': (0, 1, 2)}.get(name) if bounds else None
    if steps is None or got.ndim == np.asarray(frames[index][name]).ndim:
        return np.allclose(got, np.asarray(frames[index][name]), atol=1e-5)
    first, last = next((first, last - 1) for first, last in bounds if first <= index < last)
    places = [index + step for step in steps]
    if name == CAMERA and index == first and not got[0].any():  # a stream pads with black, an index with the first one
        got, places = got[1:], places[1:]
    wanted = [np.asarray(frames[min(max(place, first), last)][name]) for place in places]
    return all(np.allclose(*pair, atol=1e-5) for pair in zip(got, wanted, strict=True))


# -- lerobot's tools -------------------------------------------------------------------------------------------------------


def edited(out: str, folder: str) -> None:
    """A dataset of each tool, below ``out``, and how its frames differ from those of the set that it was made of."""
    made, plain = Path(out), opened(folder)
    tools.delete_episodes(plain, [0], made / 'deleted', 'local/deleted')
    tools.split_dataset(plain, {'first': [0], 'others': [1, 2]}, made / 'split')
    halves = [opened(made / 'split' / name) for name in ('others', 'first')]
    tools.merge_datasets(halves, 'local/merged', made / 'merged')
    bonus = np.arange(len(plain), dtype=np.float32)[:, None], {'dtype': 'float32', 'shape': (1,), 'names': None}
    tools.add_features(plain, {'bonus': bonus}, made / 'added', 'local/added')
    tools.remove_feature(opened(made / 'added'), 'bonus', made / 'removed', 'local/removed')
    for name in ('tasks', 'stats', 'encoded'):
        shutil.copytree(folder, made / name)
    tools.modify_tasks(opened(made / 'tasks'), new_task='sit')
    tools.recompute_stats(opened(made / 'stats'))
    if plain.meta.video_keys:
        tools.reencode_dataset(opened(made / 'encoded'), RGBEncoderConfig(vcodec='h264', crf=10))
    aggregate_datasets(['local/a', 'local/b'], 'local/two', roots=[made / 'split/others', made / 'split/first'],
                       aggr_root=made / 'two files', concatenate_videos=False)  # fmt: skip
    before = {int(item['shadowhound.stamp_ns']): item for item in (plain[number] for number in range(len(plain)))}
    names = ['deleted', 'split/first', 'split/others', 'merged', 'added', 'removed', 'tasks', 'stats', 'encoded', 'two files']
    fields: dict[str, Any] = {name: difference(opened(made / name), before) for name in names}
    merged = [opened(made / 'two files')[number] for number in range(len(plain))]
    stream = StreamingLeRobotDataset('local/set', root=made / 'two files', shuffle=False, buffer_size=1)
    fields['two files, streamed'] = compared(stream, merged)
    (made / 'said.json').write_text(json.dumps(fields))


def difference(made: LeRobotDataset, before: Mapping[int, Mapping[str, Any]]) -> dict[str, Any]:
    """Of the frames with the same stamp: the largest of numbers, and of pictures the mean, 0 to 1."""
    numbers, images, tasks = 0.0, 0.0, set()
    for place in range(len(made)):
        item = made[place]
        was = before[int(item['shadowhound.stamp_ns'])]
        for key in ('observation.state', 'action', 'timestamp', 'shadowhound.age_s'):
            numbers = max(numbers, float(np.abs(np.asarray(item[key]) - np.asarray(was[key])).max()))
        images = max(images, float(np.abs(np.asarray(item[CAMERA]) - np.asarray(was[CAMERA])).mean()))
        tasks.add(item['task'])
    return {'frames': len(made), 'episodes': made.num_episodes, 'numbers': numbers, 'pictures': images, 'tasks': sorted(tasks)}


def view(out: str, folder: str) -> None:
    from lerobot.scripts import lerobot_dataset_viz as viewer

    sys.argv = ['lerobot-dataset-viz', '--repo-id', 'local/set', '--root', folder, '--episode-index', '1', '--save', '1',
                '--output-dir', out, '--num-workers', '2']  # fmt: skip
    viewer.main()


# -- an arm ----------------------------------------------------------------------------------------------------------------


def arm(out: str) -> None:
    """Recordings of two joints: two of them, three of them, and what lerobot's tools make of three."""
    made = Path(out)
    vector = {'dtype': 'float32', 'shape': (len(JOINTS),), 'names': list(JOINTS)}
    picture = {'dtype': 'video', 'shape': (64, 96, 3), 'names': ['height', 'width', 'channels']}
    features = {'observation.state': vector, 'action': vector, 'observation.images.wrist': picture}
    recorded = LeRobotDataset.create('local/arm', ARM_FPS, features, root=made / 'grown', robot_type='so101')
    for number in range(2):
        record(recorded, number)
    recorded.finalize()
    shutil.copytree(made / 'grown', made / 'two')
    more = LeRobotDataset.resume('local/arm', root=made / 'grown')
    record(more, 2)
    more.finalize()
    whole = opened(made / 'grown')
    tools.delete_episodes(whole, [1], made / 'deleted', 'local/deleted')
    tools.split_dataset(whole, {'first': [0], 'others': [1, 2]}, made / 'split')
    tools.merge_datasets([opened(made / 'split/others'), opened(made / 'split/first')], 'local/merged', made / 'merged')
    for name in ('tasks', 'stats', 'encoded'):
        shutil.copytree(made / 'grown', made / name)
    tools.modify_tasks(opened(made / 'tasks'), new_task='another')
    tools.recompute_stats(opened(made / 'stats'))
    tools.reencode_dataset(opened(made / 'encoded'), RGBEncoderConfig(vcodec='h264', crf=30))


def record(dataset: LeRobotDataset, number: int) -> None:
    for frame in range(20 + number):
        state = np.array([number * 10 + frame / 3, -frame / 7], np.float32)
        picture = np.full((64, 96, 3), frame * 5, np.uint8)
        dataset.add_frame({'observation.state': state, 'action': state + 1, 'observation.images.wrist': picture, 'task': 'reach'})
    dataset.save_episode()


if __name__ == '__main__':
    {'load': load, 'merge': merge, 'read': read, 'tools': edited, 'view': view, 'arm': arm}[sys.argv[1]](*sys.argv[2:])
