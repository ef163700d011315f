"""Runs every campaign of this folder one after the other, each in a separate process; exit code 1 if one found a problem."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path


def main(arguments: Sequence[str]) -> int:
    """All campaigns with the same arguments."""
    failed = []
    for path in sorted(Path(__file__).parent.glob('[a-z]*.py')):
        print(f'== {path.stem}', flush=True)
        if subprocess.run([sys.executable, '-m', f'torture.{path.stem}', *arguments], check=False).returncode:
            failed.append(path.stem)
    print('failed: ' + ', '.join(failed) if failed else 'nothing was lost')
    return 1 if failed else 0


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
