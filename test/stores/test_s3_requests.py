"""Single requests to an S3 server, through botocore's client."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest


def test_botocore_does_not_import_pyopenssl() -> None:
    """Which it loads where the live page's extra has brought it, and does without as well."""
    pytest.importorskip('OpenSSL')
    program = (
        'import sys\n'
        'from shadowhound_data_logger.core.options import StoreSettings, UploadSettings\n'
        'from shadowhound_data_logger.stores import open_store\n'
        "open_store(StoreSettings(endpoint_url='http://127.0.0.1:9'), UploadSettings()).close()\n"
        "print('botocore.httpsession' in sys.modules, 'cryptography' in sys.modules)\n"
        'import OpenSSL.SSL\n'
    )
    environ = {**os.environ, 'AWS_ACCESS_KEY_ID': 'key', 'AWS_SECRET_ACCESS_KEY': 'secret'}
    done = subprocess.run([sys.executable, '-c', program], capture_output=True, text=True, env=environ, check=False)
    assert (done.stdout.split(), done.returncode) == (['True', 'False'], 0), done.stderr
