"""The smoke run of a policy, before it may be activated: a child process runs the sample and compares the output.

The child runs in a bubblewrap sandbox: it sees only the version under test, the system's libraries and Python's packages, all
read-only; it has no network, and does not see other processes. In addition, its environment contains nothing of ours but the path
of Python's packages; its memory and time are limited; and it can start no process or thread, and write no file. If the machine
cannot create a sandbox, only these limits apply, and the policy is run only if the operator allows that (``LIMITS``).
The child's output is read up to a limit, and its process group is killed when it ends.
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
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from shadowhound_data_logger.core.errors import PolicyError, PolicyRefused
from shadowhound_data_logger.core.keys import printable
from shadowhound_data_logger.core.untrusted import from_json
from shadowhound_data_logger.policies.manifest import MANIFEST, MAX_MANIFEST_BYTES, PolicyManifest, SmokeSample, parse_manifest

SMOKE_S: Final = 60.0
MEMORY_BYTES: Final = 8 << 30
"""Address space. The runtime reserves more of it than it uses."""
MAX_ANSWER_BYTES: Final = 64 << 10
WARM_UP: Final = 10
RUNS: Final = 200
RUNS_S: Final = 5.0
"""No further run starts after this time."""
MIN_RUNS: Final = 20
MAX_ARRAY_BYTES: Final = 1 << 28
SANDBOX, LIMITS = 'sandbox', 'limits'
ISOLATIONS: Final = (SANDBOX, LIMITS)
"""How a policy is isolated in its smoke run, the strongest first. With ``LIMITS`` it has the rights of this process's user."""
_SYSTEM: Final = ('/usr', '/bin', '/lib', '/lib32', '/lib64', '/etc/ld.so.cache', '/etc/alternatives', '/proc/cpuinfo',
                  '/sys/devices/system/cpu')  # fmt: skip
"""Paths that every program may read. Not the rest of /proc, which hardened units and containers do not allow to be mounted."""
_DEVICES: Final = ('/dev/null', '/dev/urandom')
_PROBE_S: Final = 10.0
_REMEDY: Final = 'sudo apt install bubblewrap  # docs/policies.md, The smoke run; or allow weaker isolation: --isolation limits'
_PDEATHSIG, _NO_NEW_PRIVS = 1, 38
_REASONS: Final = frozenset({'nan', 'output', 'slow', 'inputs', 'pickle', 'runtime', 'memory'})


@dataclass(frozen=True, slots=True)
class SmokeRun:
    """The result of a successful smoke run."""

    p99_ms: float
    """99th percentile of the duration of a step on this machine."""
    isolation: str
    """Which of ``ISOLATIONS`` was used."""


def is_enough(isolation: str | None, required: str) -> bool:
    """Whether a smoke run in this isolation (None: no smoke run) is at least what is required."""
    return isolation in ISOLATIONS[: ISOLATIONS.index(required) + 1]


def run_smoke(folder: Path, manifest: PolicyManifest, isolation: str = SANDBOX, *, limit_s: float = SMOKE_S) -> SmokeRun:
    """Run a policy for the first time, in a sandbox if this machine supports it.

    With less than the required ``isolation``, the policy is not run.

    Raises PolicyRefused: ``nan`` ``output`` ``slow`` ``inputs`` ``pickle`` ``memory`` ``time`` or ``smoke`` (it crashed), and
    PolicyError if onnxruntime is not installed, or if a sandbox is required but not available.
    """
    import tempfile  # noqa: PLC0415 - `status` imports this module

    folder = folder.absolute()
    with tempfile.TemporaryDirectory(prefix='shadowhound-policy-') as empty:
        sandbox, problem = open_sandbox(folder, empty)
        if problem and isolation != LIMITS:
            raise PolicyError(f'{manifest.id} was not run: this machine cannot create a sandbox ({problem})', remedy=_REMEDY)
        command = [*sandbox, sys.executable, '-B', '-m', __name__, str(folder)]  # -B: it cannot write bytecode files
        output, code = _run_child(command, environ_of(empty), empty, limit_s)
    if code is None:
        raise PolicyRefused('time', f'the smoke run of {manifest.id} took more than {limit_s:g} s')
    try:
        answer = from_json(output, MAX_ANSWER_BYTES)
        reason, text, p99_ms = str(answer['reason']), str(answer['text'])[:300], float(answer['p99_ms'])
    except (ValueError, KeyError, TypeError, OverflowError) as error:
        what = f'signal {-code % 128}' if code < 0 or code > 128 else f'exit code {code}'
        raise PolicyRefused('smoke', f'the smoke run of {manifest.id} ended with {what}') from error
    if reason == 'runtime':
        raise PolicyError(
            f'policies cannot be run on this machine: {text}', remedy="pip install 'shadowhound_data_logger[policies]'"
        )
    if reason:
        raise PolicyRefused(reason if reason in _REASONS else 'smoke', f'{manifest.id}: {text}')
    if not p99_ms <= manifest.p99_ms:
        text = f'{manifest.id} takes {p99_ms:.1f} ms (p99) on this machine, allowed are {manifest.p99_ms:g} ms'
        raise PolicyRefused('slow', text)
    return SmokeRun(p99_ms, LIMITS if problem else SANDBOX)


def open_sandbox(folder: Path, empty: str) -> tuple[list[str], str]:
    """The command that runs another command in a sandbox, with access to ``folder``, in the working directory ``empty``.

    If no sandbox can be created, an empty command and the reason.
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
    """The folders of Python and its packages, except those that contain the home of the user or of the data logger."""
    homes = ('~', os.environ.get('SHADOWHOUND_HOME') or '~')
    secret = [Path(os.path.expanduser(home)).absolute() for home in homes]  # noqa: PTH111 - a user may have no home
    for path in dict.fromkeys(str(Path(path).absolute()) for path in (sys.base_prefix, sys.prefix, *sys.path) if path):
        if Path(path).exists() and not any(home.is_relative_to(path) for home in secret) and path != '/usr':
            yield path


def environ_of(folder: str) -> dict[str, str]:
    """The environment of the child, with this home. Linear algebra libraries get one thread: they could not start more."""
    paths = [str(Path(path).absolute()) for path in sys.path if path]  # not the current folder, where others may write
    return {'PATH': '/usr/bin:/bin', 'HOME': folder, 'TMPDIR': folder, 'LANG': 'C.UTF-8', 'OPENBLAS_NUM_THREADS': '1',
            'OMP_NUM_THREADS': '1', 'PYTHONPATH': os.pathsep.join(paths)}  # fmt: skip


def _run_child(command: Sequence[str], environ: Mapping[str, str], folder: str, limit_s: float) -> tuple[bytes, int | None]:
    """The output of a child and its exit code; None if it took too long. Kills all processes that it started."""
    child = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=environ,
                             cwd=folder, start_new_session=True)  # fmt: skip
    with child:
        try:
            output, has_ended = _read(child, time.monotonic() + limit_s)
        finally:
            os.killpg(child.pid, signal.SIGKILL)  # the pid cannot be reused before wait()
        code = child.wait()
    return output, code if has_ended else None


def _read(child: subprocess.Popen[bytes], until_s: float) -> tuple[bytes, bool]:
    """The output of a child up to a limit, and whether it ended or reached the limit in time."""
    assert child.stdout is not None
    output = b''
    while len(output) <= MAX_ANSWER_BYTES and select.select([child.stdout], [], [], max(0.0, until_s - time.monotonic()))[0]:
        piece = os.read(child.stdout.fileno(), MAX_ANSWER_BYTES)
        if not piece:
            return output, True
        output += piece
    return output, len(output) > MAX_ANSWER_BYTES


def load_arrays(folder: Path, files: Any) -> dict[str, Any]:
    """Tensor name -> array. Raises ValueError for an array of objects, whose file is a pickle, or a file that is too large."""
    import numpy as np  # noqa: PLC0415 - in the child, and on Spark

    found = {}
    for name, file in files.items():
        path = folder / file
        if path.stat().st_size > MAX_ARRAY_BYTES:
            raise ValueError(f'{file} has more than {MAX_ARRAY_BYTES:,} bytes')
        found[name] = np.load(path, allow_pickle=False)
    return found


def open_model(path: Path) -> Any:
    """A session of onnxruntime with one thread, because a robot has no more cores to spare."""
    import onnxruntime  # type: ignore[import-untyped, unused-ignore] # noqa: PLC0415 - in the extra

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4
    return onnxruntime.InferenceSession(path.read_bytes(), options, providers=['CPUExecutionProvider'])


def worst_difference(expected: Any, found: Any) -> float:
    """The largest absolute difference between two elements of two arrays; infinite if the shapes differ."""
    import numpy as np  # noqa: PLC0415

    if expected.shape != found.shape:
        return float('inf')
    return float(np.max(np.abs(expected.astype('f8') - found.astype('f8')), initial=0.0))


def _try(folder: Path) -> tuple[str, str, float]:
    """The reason to refuse the policy (empty for none), an explanation, and the p99 of a step in ms."""
    import numpy as np  # noqa: PLC0415

    try:
        import onnxruntime  # noqa: F401, PLC0415
    except ImportError as error:
        return 'runtime', str(error), 0.0
    manifest = parse_manifest((folder / MANIFEST).read_bytes()[:MAX_MANIFEST_BYTES])
    sample: SmokeSample = manifest.smoke
    try:
        inputs, outputs = load_arrays(folder, sample.inputs), load_arrays(folder, sample.outputs)
    except (ValueError, EOFError) as error:
        return 'pickle', f'its sample cannot be read as arrays of numbers: {error}', 0.0
    session = open_model(folder / manifest.model)
    if [spec.name for spec in session.get_inputs()] != [spec.name for spec in manifest.inputs]:
        return 'inputs', 'the inputs of the model differ from those of the manifest, or are in another order', 0.0
    for spec in manifest.inputs:
        given = inputs[spec.name]
        if given.shape != spec.shape or given.dtype != spec.dtype:
            return 'inputs', f'shape or type of the sample of {spec.name} does not match the manifest', 0.0
    names = [spec.name for spec in manifest.outputs]
    for spec, found in zip(manifest.outputs, session.run(names, inputs), strict=True):
        if found.shape != spec.shape or found.dtype != spec.dtype:
            return 'output', f'{spec.name} has the shape {found.shape} ({found.dtype}), expected {spec.shape} ({spec.dtype})', 0.0
        if not np.isfinite(found).all():
            return 'nan', f'{spec.name} is not finite', 0.0
        worst = worst_difference(outputs[spec.name], found)
        if not worst <= sample.tolerance:
            return 'output', f'{spec.name} differs by {worst:.3g} from the expected output, allowed is {sample.tolerance:g}', 0.0
    return '', '', _p99_ms(session, names, inputs)


def _p99_ms(session: Any, names: list[str], inputs: dict[str, Any]) -> float:
    took_s: list[float] = []
    for _ in range(WARM_UP):
        session.run(names, inputs)
    end = time.monotonic() + RUNS_S
    while len(took_s) < RUNS and (len(took_s) < MIN_RUNS or time.monotonic() < end):
        start = time.perf_counter()
        session.run(names, inputs)
        took_s.append(time.perf_counter() - start)
    return sorted(took_s)[int(0.99 * (len(took_s) - 1))] * 1000.0


def _confine() -> None:
    """Limit privileges, memory and files, and make the kernel kill this process when its parent exits."""
    libc = ctypes.CDLL(None)
    parent = os.getppid()
    libc.prctl(_PDEATHSIG, 9, 0, 0, 0)
    if os.getppid() != parent:
        os._exit(1)
    libc.prctl(_NO_NEW_PRIVS, 1, 0, 0, 0)
    for what, limit in ((resource.RLIMIT_AS, MEMORY_BYTES), (resource.RLIMIT_FSIZE, 0), (resource.RLIMIT_CORE, 0),
                       (resource.RLIMIT_NPROC, 0), (resource.RLIMIT_CPU, int(SMOKE_S)),
                       (resource.RLIMIT_NOFILE, 256)):  # fmt: skip
        with suppress(ValueError, OSError):
            resource.setrlimit(what, (limit, limit))


def main() -> None:
    """The child process: try the policy in the given folder."""
    _confine()
    try:
        reason, text, p99_ms = _try(Path(sys.argv[1]))
    except MemoryError:
        reason, text, p99_ms = 'memory', f'it needs more than {MEMORY_BYTES:,} bytes of memory', 0.0
    except Exception as error:  # noqa: BLE001 - a runtime may raise anything for an invalid model
        what = 'memory' if 'bad_alloc' in str(error) or 'Failed to allocate' in str(error) else 'smoke'
        reason, text, p99_ms = what, f'{type(error).__name__}: {error}', 0.0
    sys.stdout.write(json.dumps({'reason': reason, 'text': text[:1000], 'p99_ms': p99_ms}))


if __name__ == '__main__':
    main()
