"""Campaigns that try to make the logger lose data: ``python -m torture.kills``, each with ``--seed``, ``--short`` and ``--json``.

They run the real programs with the helpers of the tests, which are therefore on the path.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / 'test'))
