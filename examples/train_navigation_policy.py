"""The integration guide's training script: a small network learns the robot's motion from camera frames.

    pip install '.[lake,train]'
    python examples/train_navigation_policy.py --mission-type patrol --since yesterday --epochs 5

Frames are read from the store that AWS_ENDPOINT_URL names (or from ``--folder``, the output of ``shadowhound-data fetch --to``),
the
run is logged to MLFLOW_TRACKING_URI: parameters, losses, the best checkpoint. The targets are speed (m/s) and yaw rate (rad/s)
from
one frame to the next, from the catalog's poses. The last fifth in order of time is for validation, because neighboring frames are
similar.

With ``--export DIR`` it learns from a training set of ``shadowhound-data export lerobot`` instead: the action of each frame. The
missions that are marked as validation are then held out, and the run is tagged with the digest of the dataset, so that
``shadowhound-data export where`` finds it.
"""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, Protocol

import mlflow
import numpy as np
import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader, Dataset

from shadowhound_data_logger.core.errors import DataLoggerError
from shadowhound_data_logger.lake import MissionDataset, log_dataset

EXPERIMENT = 'navigation_policy_training'
SIZE = (96, 128)
"""Height and width of the network's input."""
GAP_S = 2.5
"""Frames that are farther apart are not consecutive."""
LARGEST = (3.0, 3.0)
"""m/s and rad/s beyond which a pose has jumped."""
HELD_BACK = 0.2


class Policy(nn.Module):
    """Four convolutions, one hidden layer: 100,000 weights, so that a laptop trains it in a minute."""

    def __init__(self) -> None:
        super().__init__()
        widths = (3, 16, 32, 64, 64)
        layers: list[nn.Module] = []
        for narrow, wide in pairwise(widths):
            layers += [nn.Conv2d(narrow, wide, 3, stride=2, padding=1), nn.BatchNorm2d(wide), nn.ReLU()]
        self.layers = nn.Sequential(*layers, nn.AdaptiveAvgPool2d((2, 3)), nn.Flatten(), nn.Linear(6 * 64, 64), nn.ReLU(),
                                    nn.Dropout(0.2), nn.Linear(64, 2))  # fmt: skip

    def forward(self, frames: Tensor) -> Tensor:
        """From (n, height, width, 3) bytes to (n, 2)."""
        made: Tensor = self.layers(frames.permute(0, 3, 1, 2).float() / 127.5 - 1)
        return made


def motions(stamps_ns: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """(n, 2): forward speed and yaw rate from each frame to the next; NaN if there is no next frame or it is not consecutive."""
    found = np.full((len(poses), 2), np.nan)
    if len(poses) < 2:
        return found
    seconds = np.diff(stamps_ns) / 1e9
    step, heading = np.diff(poses[:, :2], axis=0), poses[:-1, 2]
    turn = (np.diff(poses[:, 2]) + math.pi) % (2 * math.pi) - math.pi
    with np.errstate(divide='ignore', invalid='ignore'):
        ahead = (step[:, 0] * np.cos(heading) + step[:, 1] * np.sin(heading)) / seconds
        made = np.column_stack([ahead, turn / seconds])
    made[(seconds <= 0) | (seconds > GAP_S) | (np.abs(made) > LARGEST).any(axis=1)] = np.nan
    found[:-1] = made
    return found


class Frames(Protocol):
    """Images by index."""

    def __getitems__(self, indices: Sequence[int]) -> Sequence[Mapping[str, Any]]: ...


class ExportedFrames:
    """The frames of a training set in memory, 37 KB each, with their actions as labels."""

    def __init__(self, folder: Path) -> None:
        from PIL import Image  # noqa: PLC0415 - the modules of the extra "datasets"

        from shadowhound_data_logger.datasets.lerobot import Lerobot  # noqa: PLC0415

        made = Lerobot(folder)
        images: list[np.ndarray] = []
        labels, held_back = [], []
        for row in made.rows:
            pictures = made.pictures(row, made.picture_keys()[0])
            images += [np.asarray(Image.fromarray(pixels).resize(SIZE[::-1])) for pixels in pictures]
            labels.append(made.numbers(row, 'action')[:, [0, 2]])
            held_back += [row['shadowhound/split'] == 'validation'] * row['length']
        self.images = np.array(images, np.uint8)
        self.labels = np.concatenate(labels).astype(float)
        self.held_back = np.array(held_back)

    def __len__(self) -> int:
        return len(self.images)

    def __getitems__(self, indices: Sequence[int]) -> list[dict[str, Any]]:
        return [{'image': self.images[index]} for index in indices]

    def split(self) -> tuple[np.ndarray, np.ndarray]:
        """By mission; if none is marked, the last fifth of the frames."""
        numbers = np.arange(len(self))
        if self.held_back.any():
            return numbers[~self.held_back], numbers[self.held_back]
        return split(self.labels, numbers)


class Motions(Dataset[tuple[np.ndarray, np.ndarray]]):
    """Frames by index, and the following motion, in standard deviations from the mean."""

    def __init__(self, frames: Frames, labels: np.ndarray, numbers: np.ndarray, scale: tuple[np.ndarray, np.ndarray]) -> None:
        self.frames, self.numbers = frames, numbers
        self.labels = ((labels - scale[0]) / scale[1]).astype(np.float32)

    def __len__(self) -> int:
        return len(self.numbers)

    def __getitem__(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        return self.__getitems__([index])[0]

    def __getitems__(self, indices: Sequence[int]) -> list[tuple[np.ndarray, np.ndarray]]:
        """A complete batch: its objects are fetched in parallel."""
        numbers = [int(self.numbers[index]) for index in indices]
        found = self.frames.__getitems__(numbers)
        return [(sample['image'], self.labels[number]) for sample, number in zip(found, numbers, strict=True)]


def split(labels: np.ndarray, stamps_ns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The indices of the frames for training and of those held out, the latest."""
    known = np.flatnonzero(~np.isnan(labels).any(axis=1))
    known = known[np.argsort(stamps_ns[known], kind='stable')]
    border = len(known) - max(1, round(HELD_BACK * len(known)))
    return np.sort(known[:border]), np.sort(known[border:])


def epoch(policy: Policy, batches: DataLoader[Any], optimizer: torch.optim.Optimizer | None) -> float:
    """The mean loss; without an optimizer nothing is learned."""
    policy.train(optimizer is not None)
    total, count = 0.0, 0
    with torch.set_grad_enabled(optimizer is not None):
        for frames, wanted in batches:
            loss = nn.functional.mse_loss(policy(frames), wanted)
            if optimizer is not None:
                optimizer.zero_grad()
                loss.backward()
                optimizer.step()
            total, count = total + loss.item() * len(frames), count + len(frames)
    return total / max(count, 1)


def train(
    policy: Policy, learn: Motions, check: Motions, options: argparse.Namespace, folder: Path
) -> Iterator[Mapping[str, float]]:
    """The metrics of each epoch; the best checkpoint is in ``folder``."""
    how: dict[str, Any] = {'batch_size': options.batch, 'num_workers': options.workers, 'persistent_workers': options.workers > 0}
    batches, checks = DataLoader(learn, shuffle=True, **how), DataLoader(check, **how)
    optimizer = torch.optim.AdamW(policy.parameters(), lr=options.rate, weight_decay=1e-3)
    best = math.inf
    for number in range(options.epochs):
        began = time.perf_counter()
        trained = epoch(policy, batches, optimizer)
        seconds = time.perf_counter() - began
        validated = epoch(policy, checks, None)
        if validated < best:
            best = validated
            torch.save(policy.state_dict(), folder / 'policy.pth')
        yield {'train_loss': trained, 'val_loss': validated, 'frames_per_s': len(learn) / seconds, 'epoch': number + 1}


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    options = _parser().parse_args(arguments)
    flags = {
        name: getattr(options, name) for name in ('robot', 'mission', 'mission_type', 'since', 'until') if getattr(options, name)
    }
    try:
        frames, labels, (learn, check) = _of_export(options.export) if options.export else _of_missions(options.folder, flags)
    except DataLoggerError as error:
        print(f'train_navigation_policy: {error}', file=sys.stderr)
        return 1
    if len(learn) < 2:
        print(f'train_navigation_policy: {len(learn)} frames have a motion to learn: too few', file=sys.stderr)
        return 1
    torch.manual_seed(options.seed)
    scale = labels[learn].mean(axis=0), labels[learn].std(axis=0) + 1e-3
    policy = Policy()
    mlflow.set_experiment(EXPERIMENT)
    with mlflow.start_run(run_name=options.name) as run, tempfile.TemporaryDirectory() as folder:
        if options.export:
            log_dataset(run, options.export)
        mlflow.log_params({
            'architecture': 'conv4',
            'dataset': str(options.export or ' '.join(f'{name}={value}' for name, value in flags.items()) or 'all'),
            'frames': len(learn), 'validation_frames': len(check), 'height': SIZE[0], 'width': SIZE[1],
            'batch': options.batch, 'rate': options.rate, 'epochs': options.epochs, 'seed': options.seed,
        })  # fmt: skip
        mlflow.log_dict(
            {'mean': scale[0].tolist(), 'deviation': scale[1].tolist(), 'of': ['speed_m_s', 'yaw_rate_rad_s']}, 'scale.json'
        )
        mlflow.log_metric('val_loss_of_the_mean', float(((labels[check] - scale[0]) ** 2 / scale[1] ** 2).mean()))
        for figures in train(
            policy, Motions(frames, labels, learn, scale), Motions(frames, labels, check, scale), options, Path(folder)
        ):
            mlflow.log_metrics({name: value for name, value in figures.items() if name != 'epoch'}, step=int(figures['epoch']))
            print('  '.join(f'{name} {value:.4g}' for name, value in figures.items()), flush=True)
        mlflow.log_artifact(str(Path(folder) / 'policy.pth'), artifact_path='checkpoints')
        print(f'{len(learn)} frames for training, {len(check)} to check; run {run.info.run_id} in {EXPERIMENT}')
    return 0


def _of_missions(folder: Path | None, flags: Mapping[str, Any]) -> tuple[Frames, np.ndarray, tuple[np.ndarray, np.ndarray]]:
    frames = MissionDataset(folder, size=SIZE, causal=True, **flags)
    labels = motions(frames.stamps_ns, frames.poses)
    return frames, labels, split(labels, frames.stamps_ns)


def _of_export(folder: Path) -> tuple[Frames, np.ndarray, tuple[np.ndarray, np.ndarray]]:
    frames = ExportedFrames(folder)
    return frames, frames.labels, frames.split()


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog='train_navigation_policy', description=__doc__.partition('\n')[0])
    for name, text in (('robot', 'of this robot'), ('mission', 'of a mission or its run, by how the id begins'),
                       ('mission-type', 'such as patrol'), ('since', 'yesterday, 2h, ...'), ('until', 'likewise')):  # fmt: skip
        parser.add_argument(f'--{name}', help=text)
    parser.add_argument('--folder', type=Path, help='fetched objects instead of the store')
    parser.add_argument('--export', type=Path, metavar='DIR', help='a training set of shadowhound-data export lerobot instead')
    parser.add_argument('--epochs', type=int, default=5)
    parser.add_argument('--batch', type=int, default=16)
    parser.add_argument('--rate', type=float, default=1e-3, help='learning rate')
    parser.add_argument('--workers', type=int, default=2, help='processes that read frames')
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--name', default='conv4_v1', help='of the run')
    return parser


if __name__ == '__main__':
    sys.exit(main())
