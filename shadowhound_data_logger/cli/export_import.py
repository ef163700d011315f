"""``shadowhound-data export import-lerobot`` and ``import-hdf5``: demonstrations of an arm into the store."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import click

from shadowhound_data_logger.cli.common import (
    ExitCode,
    as_json,
    examples,
    exit_code,
    the_store,
)
from shadowhound_data_logger.cli.output import counted, number, plain, print_json, print_lines
from shadowhound_data_logger.core.keys import check_name

if TYPE_CHECKING:
    from shadowhound_data_logger.datasets.imports import Demonstration

from shadowhound_data_logger.cli.export import SHOWN, exporting


def _words(text: str) -> tuple[str, ...]:
    return tuple(filter(None, (word.strip() for word in text.split(','))))


_arm = click.option('--arm', default='soarm', show_default=True, metavar='NAME', help='Name of the arm.')
_times = click.option('--times', type=click.Path(path_type=Path), metavar='FILE',
                      help="Start of each episode by the arm's clock: CSV with episode,begin_ns.")  # fmt: skip


@click.command('import-lerobot', epilog=examples('export import-lerobot so100_fetch --arm soarm --times begins.csv --degrees'))
@click.argument('folder', type=click.Path(file_okay=False, path_type=Path), metavar='DIR')
@_arm
@_times
@click.option('--degrees', 'is_degrees', is_flag=True, help='Convert joints from degrees to radians.')
@as_json
def export_import_lerobot(*, folder: Path, arm: str, times: Path | None, is_degrees: bool, as_json: bool) -> ExitCode:
    """Store a LeRobotDataset (v2.1, v3.0) of an arm.

    It stores joints and actions, not videos. Run it again to add new episodes. Exit code 1 if an episode is refused: its
    content changed, or the store has another recording of its time.
    """
    with exporting():
        from shadowhound_data_logger.datasets import imports as library  # noqa: PLC0415
    begins = library.read_times(times) if times else {}
    return _import(library.read_lerobot(folder, begins, is_degrees=is_degrees), arm, is_json=as_json)


@click.command('import-hdf5', epilog=examples('export import-hdf5 episode_0.hdf5 episode_1.hdf5 --times begins.csv --fps 50'))
@click.argument('files', type=click.Path(dir_okay=False, path_type=Path), metavar='FILE...', nargs=-1, required=True)
@_arm
@_times
@click.option('--fps', type=click.FloatRange(0.1, 10000), default=50.0, show_default=True, metavar='N', help='Frames per second.')
@click.option('--joints', default='', metavar='NAMES', help='Joint names in the order of qpos  [default: joint_0, joint_1, ...]')
@as_json
def export_import_hdf5(*, files: tuple[Path, ...], arm: str, times: Path | None, fps: float, joints: str,
                       as_json: bool) -> ExitCode:  # fmt: skip
    """Store HDF5 demonstrations (ACT, ALOHA) of an arm.

    The n-th file is episode n, from 0. It stores joints and actions, not images. Run it again with more files to add
    episodes. Exit code 1 if an episode is refused: its content changed, or the store has another recording of its time.
    """
    with exporting():
        from shadowhound_data_logger.datasets import imports as library  # noqa: PLC0415
    begins = library.read_times(times) if times else {}
    return _import(library.read_hdf5(files, begins, fps=fps, joints=_words(joints)), arm, is_json=as_json)


def _import(demonstrations: Iterator[Demonstration], arm: str, *, is_json: bool) -> ExitCode:
    from shadowhound_data_logger.datasets import imports as library  # noqa: PLC0415

    check_name(arm, '--arm')
    with exporting(), the_store() as store:
        found = library.import_episodes(demonstrations, arm, store)
    if is_json:
        print_json(asdict(found))
        return exit_code(finding=found.refused)
    lines = [plain(f'  {episode} is refused: {why}', 'red') for episode, why in list(found.refused.items())[:SHOWN]]
    lines += [plain(f'  imported before, and not in this dataset: {episode}', 'yellow') for episode in found.absent[:SHOWN]]
    rest = f', {number(len(found.refused))} refused' if found.refused else ''
    rest += f', {number(len(found.absent))} imported before are not in it' if found.absent else ''
    lines.append(plain(f'{counted(found.episodes, "new episode")} of {arm} with {number(found.samples)} samples, '
                       f'{number(found.unchanged)} in the store already{rest}.'))  # fmt: skip
    print_lines(*lines)
    return exit_code(finding=found.refused)
