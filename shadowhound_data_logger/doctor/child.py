"""The process of one check: ``python -m shadowhound_data_logger.doctor.child NAME``, context on standard input, results out."""

from __future__ import annotations

import json
import os
import sys

from shadowhound_data_logger.doctor.checks import CHECKS
from shadowhound_data_logger.doctor.context import from_child


def main() -> None:
    """One line of JSON for each result. What libraries print on standard output goes to standard error."""
    answers = os.fdopen(os.dup(1), 'w', encoding='utf-8')
    os.dup2(2, 1)
    context = from_child(sys.stdin.buffer.read())
    check = next(check for check in CHECKS if check.name == sys.argv[1])
    for result in check.run(context):
        answers.write(json.dumps(result.as_dict()) + '\n')
        answers.flush()


if __name__ == '__main__':
    main()
