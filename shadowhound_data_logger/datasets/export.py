"""Exports missions to a dataset: selects missions, builds their episodes in parallel, combines and uploads them.

If killed, a new run continues: finished episodes are in ``DIR/.shadowhound/`` until the dataset has them, and anything that
``info.json`` does not count is rebuilt with the same bytes.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass, field, replace
from multiprocessing import get_context
from pathlib import Path
from shutil import rmtree
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Final

from shadowhound_data_logger.core.durable_files import flock, replacing
from shadowhound_data_logger.core.errors import LakeError
from shadowhound_data_logger.core.options import StoreSettings, UploadSettings
from shadowhound_data_logger.datasets import plan as planning
from shadowhound_data_logger.datasets.episodes import EPISODE_JSON, build
from shadowhound_data_logger.datasets.features import ACTIONS, AUTO, ExportOptions
from shadowhound_data_logger.datasets.lerobot import REPORT
from shadowhound_data_logger.datasets.lerobot_writer import LerobotWriter
from shadowhound_data_logger.datasets.mobile import forget, synchronize, task_of, write_recordings
from shadowhound_data_logger.datasets.plan import ChosenMission, EpisodePlan
from shadowhound_data_logger.datasets.report import draw
from shadowhound_data_logger.datasets.ticks import whole_fps
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.lake.track import Track
from shadowhound_data_logger.lake.training import INFO
from shadowhound_data_logger.stores import open_store

if TYPE_CHECKING:
    from shadowhound_data_logger.datasets.cluster import Cluster

WORK: Final = '.shadowhound'
"""Working files in the dataset's folder that are not part of it."""
DROPPING: Final = f'{WORK}/dropping.json'
KNOWN: Final = 'exports.json'
"""A file in SHADOWHOUND_HOME: the folders that this machine exported to, or downloaded into."""
LOOK_S: Final = 5.0
"""Interval between checks for new objects."""
PATIENCE_S: Final = 3600.0
"""Waiting ends after this time without news about missing data."""
TRAIN, VALIDATION = 'train', 'validation'


@dataclass(slots=True)
class Exported:
    """The result of an export, or of a dry run."""

    folder: Path
    added: list[Mapping[str, Any]] = field(default_factory=list)
    """``episode.json`` of each new episode."""
    present: list[str] = field(default_factory=list)
    """Missions that the dataset already had."""
    refused: dict[str, str] = field(default_factory=dict)
    """Mission -> reason."""
    waiting: dict[str, str] = field(default_factory=dict)
    """Mission -> what is still unknown."""
    fps: int = 0
    action: str = ''
    digest: str = ''
    absent: list[str] = field(default_factory=list)
    """Missing files in the folder of a task."""
    streams: dict[str, Mapping[str, str]] = field(default_factory=dict)
    """Mission -> stream -> source, of a dry run: missions that were not rejected before their messages were read."""


Say = Callable[[str], None]


def export(  # noqa: PLR0913 - the flags of the command
    folder: Path, source: Bucket, flags: Mapping[str, Any], options: ExportOptions, *, workers: int | None = None,
    cluster: Cluster | None = None, wait: bool = False, is_dry: bool = False, findings: Findings | None = None,
    say: Say = lambda _: None, sleep: Callable[[float], object] = time.sleep,
) -> Exported:  # fmt: skip
    """Add the selected missions to the dataset in this folder, which is created if missing.

    Episodes are built here, one at a time or ``workers`` at a time, or on a cluster, by default one per core. With ``wait`` it
    returns once the gaps of each mission are known, or after an hour without news. Raises LakeError, SettingError, StoreError.
    """
    findings = Findings() if findings is None else findings
    with writing(folder, is_dry=is_dry):
        made = resumed(folder)
        options, fps, action = _settled(made, options)
        result = Exported(folder, present=made.mission_ids)
        with closing(open_store(source.settings, UploadSettings())) as store:
            waited_s, before = 0.0, dict[str, str]()
            while True:
                missions = _new(made, planning.chosen(source, flags, findings))
                with TemporaryDirectory(prefix='shadowhound-plan-') as scratch:
                    plans = list(planning.planned(source, store, missions, options, action, Path(scratch), findings))
                late = [each for each in plans if each.waits_for]
                now = {each.mission.mission_id: each.waits_for for each in late}
                waited_s, before = waited_s + LOOK_S if now == before else 0.0, now
                if not wait or not late or waited_s >= PATIENCE_S:
                    break
                say(f'{len(late)} of {len(plans)} missions wait: {late[0].mission.mission_id}: {late[0].waits_for}')
                sleep(LOOK_S)
        ready = [each for each in plans if not each.waits_for or (options.allow_gaps and each.mission.end_ns)]
        result.waiting = {each.mission.mission_id: each.waits_for for each in plans if each not in ready}
        result.action = action = planning.settled_action(ready, action)
        ready = [_only(each, action) for each in ready]
        result.fps = fps = fps or _auto_fps([each for each in ready if not planning.refusal(each, options, 0)])
        if is_dry:
            why = {each.mission.mission_id: planning.refusal(each, options, fps) for each in ready}
            result.refused = {mission: reason for mission, reason in why.items() if reason}
            result.streams = {each.mission.mission_id: _where(each) for each in ready if not why[each.mission.mission_id]}
            return result
        settings = {**options.as_json(), 'fps': fps, 'action': action}
        built = _build(ready, options, fps, source.settings, folder / WORK, settings=settings, workers=workers, cluster=cluster,
                       say=say)  # fmt: skip
        task = task_of(folder)

        def recorded(plan: EpisodePlan) -> None:
            if task is not None:
                write_recordings(task, plan, source.settings, folder / WORK / 'look')

        _assemble(made, built, options, settings, result, recorded)
        if task is not None and made.rows:
            result.absent = synchronize(task)
        return result


@contextmanager
def writing(folder: Path, *, is_dry: bool = False) -> Iterator[None]:
    """One process at a time. Raises LakeError if another one is writing."""
    if is_dry:
        yield
        return
    try:
        (folder / WORK).mkdir(parents=True, exist_ok=True)
        with flock(folder / WORK / 'lock', wait=False) as is_ours:
            if not is_ours:
                raise LakeError(f'another export is writing to {folder}', remedy='wait for it, or name another folder')
            yield
    except OSError as error:
        raise LakeError(f'{error.filename or folder} cannot be written: {error.strerror}',
                        remedy='name a folder that you can write to, on a disk with free space') from error  # fmt: skip


def resumed(folder: Path) -> LerobotWriter:
    """The dataset, after finishing a drop that was killed."""
    pending = folder / DROPPING
    if not pending.is_file():
        return LerobotWriter(folder)
    pending_drop = json.loads(pending.read_text(encoding='utf-8'))
    if not (folder / INFO).is_file():
        with replacing(folder / INFO) as file:
            file.write(json.dumps(pending_drop['info']).encode())
    made = LerobotWriter(folder)
    _drop(made, pending_drop['mission_id'])
    return LerobotWriter(folder)


def drop(folder: Path, mission_id: str) -> str:
    """Remove a mission from a dataset and record that it must not be added again; returns the new digest.

    Raises LakeError if it is not in the dataset.
    """
    with writing(folder):
        made = resumed(folder)
        if mission_id not in made.mission_ids:
            raise LakeError(f'{folder} has no episode of the mission {mission_id}')
        with replacing(folder / DROPPING, is_synced=True) as file:
            file.write(json.dumps({'mission_id': mission_id, 'info': made.info}).encode())
        return _drop(made, mission_id)


def _drop(made: LerobotWriter, mission_id: str) -> str:
    made.drop(mission_id)
    report = json.loads((made.folder / REPORT).read_text(encoding='utf-8'))
    report['episodes'] = [each for each in report['episodes'] if each['mission_id'] != mission_id]
    for name in ('refused', 'waiting'):
        report[name].pop(mission_id, None)
    report['dropped'] = sorted({*made.dropped})
    picture = made.folder / 'meta/report.png'
    picture.unlink(missing_ok=True)
    if made.rows:
        draw(made, picture)
    digest = made.commit(report, {})
    if (task := task_of(made.folder)) is not None:
        forget(task, mission_id)
        synchronize(task)
    (made.folder / DROPPING).unlink(missing_ok=True)
    return digest


def _settled(made: LerobotWriter, options: ExportOptions) -> tuple[ExportOptions, int | None, str]:
    """The first settings of a dataset apply to all of it. Raises LakeError if the settings differ."""
    if made.settings is None:
        return options, options.fps, options.action_word
    now = {**options.as_json(), 'fps': options.fps or made.settings['fps'],
           'action': made.settings['action'] if options.action == AUTO else options.action_word}  # fmt: skip
    if other := [name for name in {**made.settings, **now} if now.get(name) != made.settings.get(name)]:
        given = ', '.join(f'{name} {made.settings.get(name, "none")}' for name in other)
        raise LakeError(f'{made.folder} was created with {given}', remedy='export to another folder, or with the same settings')
    return options, made.settings['fps'], made.settings['action']


def _new(made: LerobotWriter, missions: Sequence[ChosenMission]) -> list[ChosenMission]:
    """The missions that are not in it and were not dropped."""
    known = {*made.mission_ids}
    return [each for each in missions if each.mission_id not in known and hashed(each.mission_id) not in made.dropped]


def hashed(mission_id: str) -> str:
    """The form in which a dataset remembers a dropped mission."""
    return hashlib.sha256(mission_id.encode()).hexdigest()


def _only(plan: EpisodePlan, action: str) -> EpisodePlan:
    """With ``auto``, a mission may have an action that the dataset does not use."""
    wrong = [
        each
        for each in plan.streams
        if each.name == 'action' and each.part is not None and action in ACTIONS and each.part.name != action
    ]
    if not wrong:
        return plan
    return replace(plan, streams=tuple(each for each in plan.streams if each not in wrong), missing=(*plan.missing, action))


def _auto_fps(plans: Sequence[EpisodePlan]) -> int:
    """Raises LakeError if no camera has one frame per second."""
    rates = [each.camera_hz for each in plans if each.camera_hz]
    if not rates:
        return 1
    fps = whole_fps(min(rates))
    if fps < 1:
        raise LakeError(f'the slowest camera has {min(rates):.3g} Hz, and LeRobot supports only whole frames per second',
                        remedy='record a bag (shadowhound-data node bag start), or name missions with --mission')  # fmt: skip
    return fps


def _where(plan: EpisodePlan) -> dict[str, str]:
    return {
        each.name: f'{each.recording.sink}: {each.recording.topic}, about {each.recording.messages} messages, '
        f'{each.recording.rate_hz:.3g} Hz' for each in plan.streams
    }  # fmt: skip


Built = list[tuple[EpisodePlan, dict[str, Any], Path]]


def _build(plans: Sequence[EpisodePlan], options: ExportOptions, fps: int, store: StoreSettings, work: Path, *,  # noqa: PLR0913
           settings: Mapping[str, Any], workers: int | None, cluster: Cluster | None, say: Say) -> Built:  # fmt: skip
    folders = [work / f'{hashed(each.mission.mission_id)[:16]}-{_episode_key(each, settings, options)}' for each in plans]
    jobs = [(each, options, fps, store, folder) for each, folder in zip(plans, folders, strict=True)]
    if cluster is not None:
        return [(job[0], episode, job[-1]) for job, episode in zip(jobs, cluster.built(jobs, workers, say), strict=True)]
    found: Built = []
    if workers in {None, 1} or len(jobs) < 2:
        for number, job in enumerate(jobs):
            say(f'episode {number + 1} of {len(jobs)}: {job[0].mission.mission_id}')
            found.append((job[0], build(*job), job[-1]))
        return found
    with ProcessPoolExecutor(workers, mp_context=get_context('spawn')) as pool:
        futures = [pool.submit(build, *job) for job in jobs]
        for number, (job, future) in enumerate(zip(jobs, futures, strict=True)):
            mission = job[0].mission.mission_id
            try:
                found.append((job[0], future.result(), job[-1]))
            except BrokenProcessPool as error:
                raise LakeError(f'a process was killed while building episodes; {mission} is not finished, and nothing was added',
                                remedy='run it again, with fewer --workers if memory ran out: '
                                       'finished episodes are kept') from error  # fmt: skip
            say(f'episode {number + 1} of {len(jobs)}: {mission}')
    return found


def _episode_key(plan: EpisodePlan, settings: Mapping[str, Any], options: ExportOptions) -> str:
    """The key of an episode: an earlier result is reused if it has the same settings, objects and gaps."""
    inputs = [settings, options.validation_label, options.max_stale, options.allow_gaps, sorted(plan.topics.items()),
              plan.missing, _where(plan),
            [(name, sorted(track.key.to_pylist())) for name, track in sorted(_tracks_of(plan).items())],
            [[each.sha256 for each in bag.slices] for bag in plan.bags],
            plan.arm and (plan.arm.why, plan.arm.clock and plan.arm.clock.as_json())]  # fmt: skip
    whole = hashlib.sha256(json.dumps(inputs, default=str).encode())
    for column in (*plan.gaps.to_pydict().items(), *map(asdict, plan.labels)):
        whole.update(json.dumps(column, default=str).encode())
    return whole.hexdigest()[:16]


def _tracks_of(plan: EpisodePlan) -> dict[str, Track]:
    return {**plan.tracks, **(plan.arm.tracks if plan.arm else {})}


def _assemble(made: LerobotWriter, built: Built, options: ExportOptions, settings: Mapping[str, Any], result: Exported,
                  recorded: Callable[[EpisodePlan], None]) -> None:  # fmt: skip
    folder = made.folder
    report: dict[str, Any] = {'settings': settings, 'episodes': _earlier_reports(made), 'dropped': made.dropped}
    new: dict[str, Path] = {}
    for plan, episode, work in built:
        mission = plan.mission.mission_id
        if 'refused' in episode:
            result.refused[mission] = episode['refused']
            continue
        is_chosen = options.validation_label in episode.get('labels', ())
        split = VALIDATION if is_chosen else split_of(mission, options.validation)
        try:
            recorded(plan)
            made.add(episode, work, options, split)
        except LakeError as error:
            result.refused[mission] = error.what
            continue
        result.added.append(episode)
        new[mission] = work
        kept = {name: value for name, value in episode.items() if name not in {'histograms', 'sizes'}}
        report['episodes'].append({'split': split, **kept})
    report |= {'refused': result.refused, 'waiting': result.waiting}
    if not made.rows:
        return
    if new or not (folder / INFO).is_file() or report != _read_json(folder / REPORT):
        if new:
            made.join_videos()
            draw(made, _create_folder(folder / 'meta') / 'report.png')
        made.commit(report, new)
    result.digest = made.digest
    for work in (folder / WORK).glob('*-*'):
        if (work / EPISODE_JSON).is_file():
            rmtree(work)


def split_of(mission_id: str, validation: float) -> str:
    """Training or validation split of a mission: from its id only, so that it does not change when others are added."""
    return VALIDATION if int(hashed(mission_id)[:8], 16) / 0x1_0000_0000 < validation else TRAIN


def _earlier_reports(made: LerobotWriter) -> list[dict[str, Any]]:
    """Reports of the episodes in the dataset: a kill may have happened between a report and ``info.json``."""
    found = _read_json(made.folder / REPORT) if made.info else {}
    return [each for each in found.get('episodes', []) if each['mission_id'] in made.mission_ids]


def _read_json(path: Path) -> dict[str, Any]:
    return dict(json.loads(path.read_text(encoding='utf-8'))) if path.is_file() else {}


def _create_folder(path: Path) -> Path:
    path.mkdir(parents=True, exist_ok=True)
    return path


# -- known datasets -------------------------------------------------------------------------------------------------------


def remember(home: Path, folder: Path) -> None:
    """Remember that this folder is a dataset: ``export where`` and ``export drop`` read all of them. Raises OSError."""
    home.mkdir(parents=True, exist_ok=True)
    with flock(home / f'{KNOWN}.lock'):
        found = {*known_folders(home), folder.absolute()}
        with replacing(home / KNOWN, is_synced=True) as file:
            file.write(json.dumps(sorted(map(os.fspath, found)), indent=1).encode())


def known_folders(home: Path) -> list[Path]:
    """The folders that still exist."""
    try:
        folders = json.loads((home / KNOWN).read_text(encoding='utf-8'))
    except (OSError, ValueError):
        return []
    return [Path(each) for each in folders if isinstance(each, str) and (Path(each) / INFO).is_file()]
