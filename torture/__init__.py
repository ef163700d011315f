"""Campaigns that try to make the logger lose data: ``python -m torture.kills``, each with ``--seed``, ``--short`` and ``--json``.

They drive the real programs with the means of the tests, which therefore stand on the path.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / 'test'))
