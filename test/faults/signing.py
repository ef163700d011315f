"""AWS Signature Version 4 for a request that somebody else signed and that was changed on its way.

https://docs.aws.amazon.com/AmazonS3/latest/API/sig-v4-header-based-auth.html
"""

from __future__ import annotations

import hashlib
import hmac
import re
from collections.abc import Mapping
from typing import Final
from urllib.parse import urlsplit

_AUTHORIZATION: Final = re.compile(r'AWS4-HMAC-SHA256 Credential=([^,]+), ?SignedHeaders=([^,]+), ?Signature=([0-9a-f]+)')


def signed_again(method: str, target: str, headers: Mapping[str, str], secret: str) -> dict[str, str]:
    """The headers (names in lower case) with a signature that fits them as they are now; same key, scope and payload hash."""
    found = _AUTHORIZATION.fullmatch(headers['authorization'])
    assert found, headers['authorization']
    credential, names, _ = found.groups()
    key, *_, region, service, _ = credential.split('/')
    stamp = headers['x-amz-date']
    scope = f'{stamp[:8]}/{region}/{service}/aws4_request'
    signed = [name for name in names.split(';') if name in headers]
    url = urlsplit(target)
    query = '&'.join(sorted(part if '=' in part else f'{part}=' for part in url.query.split('&') if part))
    lines = [f'{name}:{" ".join(headers[name].split())}' for name in signed]
    canonical = '\n'.join([method, url.path, query, *lines, '', ';'.join(signed), headers['x-amz-content-sha256']])
    text = '\n'.join(['AWS4-HMAC-SHA256', stamp, scope, hashlib.sha256(canonical.encode()).hexdigest()])
    signing = f'AWS4{secret}'.encode()
    for part in (*scope.split('/'), text):
        signing = hmac.digest(signing, part.encode(), 'sha256')
    authorization = f'AWS4-HMAC-SHA256 Credential={key}/{scope}, SignedHeaders={";".join(signed)}, Signature={signing.hex()}'
    return {**headers, 'authorization': authorization}
