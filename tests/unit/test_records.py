"""The append-only file under a run: what was written whole is found again, what was not is gone."""

import os

import pytest

from sl3d_slam.errors import OutputError
from sl3d_slam.records import RecordFile


def test_records_are_found_again_and_the_newest_counts(tmp_path, rng):
    contents = {f"n {k}": rng.bytes(int(rng.integers(0, 5000))) for k in range(20)}
    file = RecordFile.open(tmp_path / "deep" / "records")
    for name, content in contents.items():
        file[name] = b"older"
        file[name] = content
    file.close()
    again = RecordFile.open(tmp_path / "deep" / "records")
    assert {name: again[name] for name in contents} == contents
    assert len(again) == 20
    assert "n 20" not in again
    with pytest.raises(KeyError):
        again["n 20"]


@pytest.mark.parametrize("damage", ["cut", "flip"])
def test_a_torn_end_is_cut_off_and_writing_goes_on(tmp_path, damage):
    path = tmp_path / "records"
    file = RecordFile.open(path)
    file["first"], file["second"] = b"1" * 100, b"2" * 100
    file.close()
    raw = bytearray(path.read_bytes())
    if damage == "cut":
        del raw[-30:]
    else:
        raw[-30] ^= 1
    path.write_bytes(raw)
    file = RecordFile.open(path)
    assert file["first"] == b"1" * 100
    assert "second" not in file
    file["third"] = b"3"
    file.close()
    assert RecordFile.open(path)["third"] == b"3"


def test_a_full_disk_is_one_sentence_and_what_was_written_stays(tmp_path):
    file = RecordFile.open(tmp_path / "records")
    file["kept"] = b"here"
    full = RecordFile.temporary()
    device = os.open("/dev/full", os.O_WRONLY)
    os.dup2(device, full._file.fileno())
    with pytest.raises(OutputError, match=r"a temporary file in .*: cannot grow because the disk"):
        full["more"] = b"x"
    assert file["kept"] == b"here"


def test_a_folder_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "plain").write_text("a file")
    with pytest.raises(OutputError, match=r"plain.*cannot be written"):
        RecordFile.open(tmp_path / "plain" / "records")
