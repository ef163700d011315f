"""One run of a policy before it may run: a child process with limits, a sample with the output that has to come out.

The child runs in a sandbox of bubblewrap: of the machine's files it sees the version that it tries, the system's libraries and
Python's packages, all read-only; it has no network, and sees no other process. Besides, it has no environment of ours but the
path of Python's packages, limits of memory and time, can start no process and no thread, and write no file. Where the machine
cannot make a sandbox, only these limits are in force, and a policy is run only where the operator allows that (``LIMITS``).
What the child says is read with a bound, and its process group ends with it.
"""

from __future__ import annotations

import ctypes
import json
import os
import resource
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from shadowhound_data_logger.core.errors import PolicyError, PolicyRefused
from shadowhound_data_logger.core.keys import printable
from shadowhound_data_logger.core.untrusted import from_json
from shadowhound_data_logger.policies.manifest import MANIFEST, MOST_MANIFEST_BYTES, PolicyManifest, SmokeSample, parse_manifest

SMOKE_S: Final = 60.0
MEMORY_BYTES: Final = 8 << 30
"""Of address space, which the runtime reserves much of."""
MOST_ANSWER_BYTES: Final = 64 << 10
WARM_UP: Final = 10
RUNS: Final = 200
RUNS_S: Final = 5.0
"""No further run begins after that."""
LEAST_RUNS: Final = 20
MOST_ARRAY_BYTES: Final = 1 << 28
SANDBOX, LIMITS = 'sandbox', 'limits'
ISOLATIONS: Final = (SANDBOX, LIMITS)
"""How a policy is run for the first time, the strongest first. With ``LIMITS`` it has the rights of this process' user."""
_SYSTEM: Final = ('/usr', '/bin', '/lib', '/lib32', '/lib64', '/etc/ld.so.cache', '/etc/alternatives', '/proc/cpuinfo',
                  '/sys/devices/system/cpu')  # fmt: skip
"""What every program may read. Without the rest of /proc, which no hardened unit and no container lets anybody mount."""
_DEVICES: Final = ('/dev/null', '/dev/urandom')
_PROBE_S: Final = 10.0
_REMEDY: Final = 'sudo apt install bubblewrap  # docs/policies.md, The smoke run; or allow less: --isolation limits'
_PDEATHSIG, _NO_NEW_PRIVS = 1, 38
_REASONS: Final = frozenset({'nan', 'output', 'slow', 'inputs', 'pickle', 'runtime', 'memory'})


@dataclass(frozen=True, slots=True)
class SmokeRun:
    """What a smoke run that succeeded says."""

    p99_ms: float
    """Of a step on this machine."""
    isolation: str
    """Which of ``ISOLATIONS`` was in force."""


def is_enough(isolation: str | None, required: str) -> bool:
    """Whether a smoke run in this isolation, None for none, is all that is required."""
    return isolation in ISOLATIONS[: ISOLATIONS.index(required) + 1]


def run_smoke(folder: Path, manifest: PolicyManifest, isolation: str = SANDBOX, *, limit_s: float = SMOKE_S) -> SmokeRun:
    """Run a policy for the first time, in a sandbox where this machine allows it.

    ``isolation`` is the least that has to be in force: with less nothing is run.

    Raises PolicyRefused: ``nan`` ``output`` ``slow`` ``inputs`` ``pickle`` ``memory`` ``time`` or ``smoke`` (it crashed), and
    PolicyError where this machine has no onnxruntime, or no sandbox while one is required.
    """
    folder = folder.absolute()
    with tempfile.TemporaryDirectory(prefix='shadowhound-policy-') as empty:
        sandbox, problem = open_sandbox(folder, empty)
        if problem and isolation != LIMITS:
            raise PolicyError(f'{manifest.id} is not run: this machine lets nobody make a sandbox ({problem})', remedy=_REMEDY)
        command = [*sandbox, sys.executable, '-B', '-m', __name__, str(folder)]  # it may write no file, such as one of bytecode
        told, code = _ran(command, environ_of(empty), empty, limit_s)
    if code is None:
        raise PolicyRefused('time', f'the smoke run of {manifest.id} took more than {limit_s:g} s')
    try:
        answer = from_json(told, MOST_ANSWER_BYTES)
        reason, text, p99_ms = str(answer['reason']), str(answer['text'])[:300], float(answer['p99_ms'])
    except (ValueError, KeyError, TypeError, OverflowError) as error:
        what = f'signal {-code % 128}' if code < 0 or code > 128 else f'exit code {code}'
        raise PolicyRefused('smoke', f'the smoke run of {manifest.id} ended with {what}') from error
    if reason == 'runtime':
        raise PolicyError(f'a policy cannot be run here: {text}', remedy="pip install 'shadowhound_data_logger[policies]'")
    if reason:
        raise PolicyRefused(reason if reason in _REASONS else 'smoke', f'{manifest.id}: {text}')
    if not p99_ms <= manifest.p99_ms:
        text = f'{manifest.id} takes {p99_ms:.1f} ms (p99) on this machine, allowed are {manifest.p99_ms:g} ms'
        raise PolicyRefused('slow', text)
    return SmokeRun(p99_ms, LIMITS if problem else SANDBOX)


def open_sandbox(folder: Path, empty: str) -> tuple[list[str], str]:
    """The command that runs another one in a sandbox, which sees this folder and works in the empty one.

    Without one, nothing and why not.
    """
    program = shutil.which('bwrap')
    if program is None:
        return [], 'bubblewrap is not installed'
    command = [program, '--unshare-all', '--die-with-parent', '--cap-drop', 'ALL']
    for path in _SYSTEM:
        command += ['--ro-bind-try', path, path]
    for path in (*_packages(), str(folder)):
        command += ['--ro-bind', path, path]
    for path in _DEVICES:
        command += ['--dev-bind-try', path, path]
    command += ['--dir', empty, '--chdir', empty, '--remount-ro', '/']
    try:
        probe = subprocess.run([*command, 'true'], stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
                               env=environ_of(empty), timeout=_PROBE_S, check=False)  # fmt: skip
    except (OSError, subprocess.TimeoutExpired) as error:
        return [], f'bwrap: {error}'
    if probe.returncode:
        return [], printable(probe.stderr.decode(errors='replace').strip())[-200:] or f'bwrap: exit code {probe.returncode}'
    return command, ''


def _packages() -> Iterator[str]:
    """Where Python and its packages are; no folder that has the user's home, or that of the data logger, in it."""
    homes = ('~', os.environ.get('SHADOWHOUND_HOME') or '~')
    secret = [Path(os.path.expanduser(home)).absolute() for home in homes]  # noqa: PTH111 - a user may have no home
    for path in dict.fromkeys(str(Path(path).absolute()) for path in (sys.base_prefix, sys.prefix, *sys.path) if path):
        if Path(path).exists() and not any(home.is_relative_to(path) for home in secret) and path != '/usr':
            yield path


def environ_of(folder: str) -> dict[str, str]:
    """The environment of the child, which works in this folder. One thread: those of linear algebra could not start theirs."""
    paths = [str(Path(path).absolute()) for path in sys.path if path]  # without the current folder, whoever may write in it
    return {'PATH': '/usr/bin:/bin', 'HOME': folder, 'TMPDIR': folder, 'LANG': 'C.UTF-8', 'OPENBLAS_NUM_THREADS': '1',
            'OMP_NUM_THREADS': '1', 'PYTHONPATH': os.pathsep.join(paths)}  # fmt: skip


def _ran(command: Sequence[str], environ: Mapping[str, str], folder: str, limit_s: float) -> tuple[bytes, int | None]:
    """What a child writes, and its exit code; None where it took longer. Nothing that it started outlives this."""
    child = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=environ,
                             cwd=folder, start_new_session=True)  # fmt: skip
    with child:
        try:
            told, has_ended = _read(child, time.monotonic() + limit_s)
        finally:
            os.killpg(child.pid, signal.SIGKILL)  # its number is taken until it was waited for
        code = child.wait()
    return told, code if has_ended else None


def _read(child: subprocess.Popen[bytes], until_s: float) -> tuple[bytes, bool]:
    """What it writes, up to a bound, and whether that was all."""
    assert child.stdout is not None
    told = b''
    while len(told) <= MOST_ANSWER_BYTES and select.select([child.stdout], [], [], max(0.0, until_s - time.monotonic()))[0]:
        piece = os.read(child.stdout.fileno(), MOST_ANSWER_BYTES)
        if not piece:
            return told, True
        told += piece
    return told, len(told) > MOST_ANSWER_BYTES


def load_arrays(folder: Path, files: Any) -> dict[str, Any]:
    """Tensor name -> array. Raises ValueError for an array of objects, whose file is a pickle, or one that is too large."""
    import numpy as np  # noqa: PLC0415 - in the child, and on Spark

    found = {}
    for name, file in files.items():
        path = folder / file
        if path.stat().st_size > MOST_ARRAY_BYTES:
            raise ValueError(f'{file} has more than {MOST_ARRAY_BYTES:,} bytes')
        found[name] = np.load(path, allow_pickle=False)
    return found


def open_model(path: Path) -> Any:
    """A session of onnxruntime on one core: what a robot has to spare."""
    import onnxruntime  # type: ignore[import-untyped, unused-ignore] # noqa: PLC0415 - of the extra

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4
    return onnxruntime.InferenceSession(path.read_bytes(), options, providers=['CPUExecutionProvider'])


def worst_difference(expected: Any, found: Any) -> float:
    """Of two arrays, the largest between two elements; infinite where the shapes differ."""
    import numpy as np  # noqa: PLC0415

    if expected.shape != found.shape:
        return float('inf')
    return float(np.max(np.abs(expected.astype('f8') - found.astype('f8')), initial=0.0))


def _try(folder: Path) -> tuple[str, str, float]:
    """The reason against it (empty for none), in words, and the p99 in ms."""
    import numpy as np  # noqa: PLC0415

    try:
        import onnxruntime  # noqa: F401, PLC0415
    except ImportError as error:
        return 'runtime', str(error), 0.0
    manifest = parse_manifest((folder / MANIFEST).read_bytes()[:MOST_MANIFEST_BYTES])
    sample: SmokeSample = manifest.smoke
    try:
        inputs, outputs = load_arrays(folder, sample.inputs), load_arrays(folder, sample.outputs)
    except (ValueError, EOFError) as error:
        return 'pickle', f'its sample cannot be read as arrays of numbers: {error}', 0.0
    session = open_model(folder / manifest.model)
    if [spec.name for spec in session.get_inputs()] != [spec.name for spec in manifest.inputs]:
        return 'inputs', 'the model has other inputs than the manifest, or in another order', 0.0
    for spec in manifest.inputs:
        given = inputs[spec.name]
        if given.shape != spec.shape or given.dtype != spec.dtype:
            return 'inputs', f'the sample of {spec.name} has another shape or type than the manifest says', 0.0
    names = [spec.name for spec in manifest.outputs]
    for spec, found in zip(manifest.outputs, session.run(names, inputs), strict=True):
        if found.shape != spec.shape or found.dtype != spec.dtype:
            return 'output', f'{spec.name} has the shape {found.shape}, {spec.shape} is promised', 0.0
        if not np.isfinite(found).all():
            return 'nan', f'{spec.name} is not finite', 0.0
        worst = worst_difference(outputs[spec.name], found)
        if not worst <= sample.tolerance:
            return 'output', f'{spec.name} differs by {worst:.3g} from what is promised, allowed is {sample.tolerance:g}', 0.0
    return '', '', _p99_ms(session, names, inputs)


def _p99_ms(session: Any, names: list[str], inputs: dict[str, Any]) -> float:
    took_s: list[float] = []
    for _ in range(WARM_UP):
        session.run(names, inputs)
    end = time.monotonic() + RUNS_S
    while len(took_s) < RUNS and (len(took_s) < LEAST_RUNS or time.monotonic() < end):
        begin = time.perf_counter()
        session.run(names, inputs)
        took_s.append(time.perf_counter() - begin)
    return sorted(took_s)[int(0.99 * (len(took_s) - 1))] * 1000.0


def _confine() -> None:
    """Limits of privileges, memory and files; and this process ends with its parent."""
    libc = ctypes.CDLL(None)
    parent = os.getppid()
    libc.prctl(_PDEATHSIG, 9, 0, 0, 0)
    if os.getppid() != parent:
        os._exit(1)
    libc.prctl(_NO_NEW_PRIVS, 1, 0, 0, 0)
    for what, most in ((resource.RLIMIT_AS, MEMORY_BYTES), (resource.RLIMIT_FSIZE, 0), (resource.RLIMIT_CORE, 0),
                       (resource.RLIMIT_NPROC, 0), (resource.RLIMIT_CPU, int(SMOKE_S)),
                       (resource.RLIMIT_NOFILE, 256)):  # fmt: skip
        with suppress(ValueError, OSError):
            resource.setrlimit(what, (most, most))


def main() -> None:
    """The child: tries the policy in the folder that it is given."""
    _confine()
    try:
        reason, text, p99_ms = _try(Path(sys.argv[1]))
    except MemoryError:
        reason, text, p99_ms = 'memory', f'it needs more than {MEMORY_BYTES:,} bytes of memory', 0.0
    except Exception as error:  # noqa: BLE001 - whatever a runtime says of a model
        what = 'memory' if 'bad_alloc' in str(error) or 'Failed to allocate' in str(error) else 'smoke'
        reason, text, p99_ms = what, f'{type(error).__name__}: {error}', 0.0
    sys.stdout.write(json.dumps({'reason': reason, 'text': text[:1000], 'p99_ms': p99_ms}))


if __name__ == '__main__':
    main()
