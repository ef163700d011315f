"""AWS Signature Version 4 in the headers of one S3 request whose body's SHA-256 is known.

https://docs.aws.amazon.com/AmazonS3/latest/API/sig-v4-header-based-auth.html. botocore's own signer gives the same (a test
holds the two against each other) and takes several times the CPU: the robot signs each object that leaves it.
"""

from __future__ import annotations

import hashlib
import hmac
from collections.abc import Mapping
from datetime import datetime
from typing import Final

from botocore.credentials import ReadOnlyCredentials

ALGORITHM: Final = 'AWS4-HMAC-SHA256'


def signed(method: str, target: str, headers: Mapping[str, str], sha256: str, *, credentials: ReadOnlyCredentials, region: str,
           now: datetime) -> dict[str, str]:  # fmt: skip
    """The headers with a signature over all of them; ``host`` has to be among them.

    ``target`` is percent-encoded, as it stands in the request line, its query (if any) by the names in order; ``headers`` have
    lower-case names; ``sha256`` is the body's, in hex; ``now`` is UTC.
    """
    stamp = now.strftime('%Y%m%dT%H%M%SZ')
    full = {**headers, 'x-amz-date': stamp, 'x-amz-content-sha256': sha256}
    if credentials.token:
        full['x-amz-security-token'] = credentials.token
    names = sorted(full)
    lines = [f'{name}:{" ".join(full[name].split())}' for name in names]
    which = ';'.join(names)
    path, _, query = target.partition('?')
    canonical = '\n'.join([method, path, query, *lines, '', which, sha256])
    scope = f'{stamp[:8]}/{region}/s3/aws4_request'
    text = '\n'.join([ALGORITHM, stamp, scope, hashlib.sha256(canonical.encode()).hexdigest()])
    key = f'AWS4{credentials.secret_key}'.encode()
    for part in (*scope.split('/'), text):
        key = hmac.digest(key, part.encode(), 'sha256')
    credential = f'{credentials.access_key}/{scope}'
    return {**full, 'authorization': f'{ALGORITHM} Credential={credential}, SignedHeaders={which}, Signature={key.hex()}'}
