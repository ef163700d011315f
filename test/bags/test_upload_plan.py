"""Finished bags are recognized, whatever their metadata.yaml contains."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from bags.real_bags import NAME, write_ours

from shadowhound_data_logger.bags.upload_plan import read_finished
from shadowhound_data_logger.core.errors import BagDamaged

BOMB = b'a: &a [x, x]\n' + b''.join(
    b'%c: &%c [%s]\n' % (ord('b') + n, ord('b') + n, b', '.join([b'*%c' % (ord('a') + n)] * 9)) for n in range(12)
)


@pytest.mark.parametrize('content', [
    b'', bytes(100), b'\xff\xfe', b'- 1\n', b'[' * 3000, b'{a: ' * 3000, BOMB + b'rosbag2_bagfile_information: *m\n',
    b'rosbag2_bagfile_information: &x {starting_time: *x, relative_file_paths: *x}\n',
    b'rosbag2_bagfile_information: !!python/object/apply:os.system ["true"]\n', b'#' + b'x' * (5 << 20),
], ids=['empty', 'zeros', 'no text', 'a list', 'deep', 'deeper', 'a bomb', 'itself', 'a program', 'huge'])  # fmt: skip
def test_invalid_metadata_is_rejected(tmp_path: Path, content: bytes) -> None:
    """Immediately, with the correct error."""
    write_ours(tmp_path / NAME, slices=1, each=5)
    (tmp_path / NAME / 'metadata.yaml').write_bytes(content)
    with pytest.raises(BagDamaged, match='is not metadata of a rosbag2 bag'):
        read_finished(tmp_path / NAME)


@pytest.mark.parametrize(('what', 'value'), [
    ('message_count', '-11'), ('message_count', '.inf'), ('message_count', '.nan'), ('message_count', '9' * 5000),
    ('nanoseconds_since_epoch', '[]'), ('relative_file_paths', '7'), ('topics_with_message_count', '7'),
])  # fmt: skip
def test_a_metadata_with_a_wrong_value_is_refused(tmp_path: Path, what: str, value: str) -> None:
    """In any field."""
    write_ours(tmp_path / NAME, slices=1, each=5)
    path = tmp_path / NAME / 'metadata.yaml'
    path.write_text(re.sub(rf'( +)({what}:).*', rf'\1\2 {value}\n\1other_{what}:', path.read_text(), count=1))
    with pytest.raises(BagDamaged, match='is not metadata of a rosbag2 bag'):
        read_finished(tmp_path / NAME)
