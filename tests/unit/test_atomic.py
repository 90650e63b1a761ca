import errno
import os

import pytest

from sl3d_slam.errors import OutputError
from sl3d_slam.files import prepare_run_folder, prove_writable, write_whole
from sl3d_slam.io.json_files import write_json


def test_content_is_written_as_given(tmp_path):
    write_whole(tmp_path / "a.bin", b"\x00\xff\n")
    write_whole(tmp_path / "b.txt", "Straße\n")
    assert (tmp_path / "a.bin").read_bytes() == b"\x00\xff\n"
    assert (tmp_path / "b.txt").read_bytes() == b"Stra\xc3\x9fe\n"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.bin", "b.txt"]


def test_file_gets_the_permissions_of_any_new_file(tmp_path):
    (tmp_path / "plain").write_bytes(b"")
    write_whole(tmp_path / "whole", b"")
    assert (tmp_path / "whole").stat().st_mode == (tmp_path / "plain").stat().st_mode


@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_failure_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch, step):
    path = tmp_path / "poses.txt"
    path.write_text("old")

    def full(*_args, **_kwargs):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, step, full)
    with pytest.raises(OutputError, match=r"poses\.txt: .*disk is full"):
        write_whole(path, "new")
    monkeypatch.undo()
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["poses.txt"]


def test_interruption_leaves_no_temporary_file(tmp_path, monkeypatch):
    def interrupt(*_args, **_kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "fsync", interrupt)
    with pytest.raises(KeyboardInterrupt):
        write_whole(tmp_path / "x", b"new")
    assert list(tmp_path.iterdir()) == []


def test_missing_folder_and_folder_in_the_way_are_named(tmp_path):
    with pytest.raises(OutputError, match=r"nowhere.*does not exist"):
        write_whole(tmp_path / "nowhere" / "x", b"")
    (tmp_path / "taken").mkdir()
    with pytest.raises(OutputError, match="taken"):
        write_whole(tmp_path / "taken", b"")
    assert [p.name for p in tmp_path.iterdir()] == ["taken"]


def test_run_folder_is_created_with_its_parents_and_left_empty(tmp_path):
    assert prepare_run_folder(tmp_path / "a" / "b") == tmp_path / "a" / "b"
    assert list((tmp_path / "a" / "b").iterdir()) == []
    prepare_run_folder(tmp_path / "a" / "b")  # a second time is no error


def test_run_folder_that_cannot_be_one_is_named(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match=r"file: is a file"):
        prepare_run_folder(tmp_path / "file")
    with pytest.raises(OutputError, match=r"sub: .*is a file, not a folder"):
        prepare_run_folder(tmp_path / "file" / "sub")

    def read_only(*_args, **_kwargs):
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr("pathlib.Path.write_bytes", read_only)
    with pytest.raises(OutputError, match="read-only"):
        prepare_run_folder(tmp_path / "ro")


def test_json_refuses_nan_and_keeps_the_old_file(tmp_path):
    path = tmp_path / "metrics.json"
    path.write_text("{}")
    with pytest.raises(OutputError, match=r"metrics\.json"):
        write_json(path, {"ate_rmse_m": float("nan")})
    with pytest.raises(OutputError, match=r"metrics\.json"):
        write_json(path, {"what": object()})
    assert path.read_text() == "{}"


def test_a_file_that_can_be_written_is_not_touched_by_the_proof(tmp_path):
    (tmp_path / "old.PNG").write_text("precious")
    prove_writable(tmp_path / "old.PNG", (".png",))
    prove_writable(tmp_path / "new.anything")
    assert [path.name for path in tmp_path.iterdir()] == ["old.PNG"]
    assert (tmp_path / "old.PNG").read_text() == "precious"


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("a.txt", "ends in .png, .ply"),
        ("nowhere/a.png", "its folder does not exist"),
        ("file/a.png", "is a file, not a folder"),
        ("folder.png", "it is a folder"),
    ],
)
def test_a_file_that_cannot_be_written_is_named_before_the_work(tmp_path, name, reason):
    (tmp_path / "file").write_text("")
    (tmp_path / "folder.png").mkdir()
    with pytest.raises(OutputError, match=reason) as found:
        prove_writable(tmp_path / name, (".png", ".ply"))
    assert str(tmp_path / name) in str(found.value)
