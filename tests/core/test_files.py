"""Files and folders are whole or absent; a full disk is one line."""

import errno
import os
import pickle
import resource
import shutil

import pytest
from hypothesis import given
from hypothesis import strategies as st

from nerf2real.core import files


def listing(folder):
  return sorted(path.name for path in folder.iterdir())


@given(content=st.one_of(st.text(), st.binary()))
def test_what_is_written_is_read(tmp_path_factory, content):
  path = tmp_path_factory.mktemp("folder") / "file.bin"
  files.write_atomically(path, "an older, longer file")
  files.write_atomically(path, content)
  assert path.read_bytes() == (content.encode() if isinstance(content, str) else content)
  assert listing(path.parent) == ["file.bin"]


def test_an_error_names_the_file_that_was_asked_for(tmp_path):
  path = tmp_path / "none" / "page.html"
  with pytest.raises(FileNotFoundError) as caught:
    files.write_atomically(path, "x")
  assert caught.value.filename == str(path)
  with pytest.raises(FileNotFoundError) as caught, files.atomic_folder(tmp_path / "new") as partial:
    (partial / "sfm" / "cameras.txt").write_text("x")
  assert caught.value.filename == str(tmp_path / "new" / "sfm" / "cameras.txt")


def test_writer_by_name_gets_the_suffix(tmp_path):
  with files.atomic_path(tmp_path / "picture.png") as partial:
    assert partial.suffix == ".png" and partial.parent == tmp_path
    partial.write_bytes(b"x")
    assert not (tmp_path / "picture.png").exists()
  assert listing(tmp_path) == ["picture.png"]


def test_failed_write_keeps_the_old_file(tmp_path):
  target = tmp_path / "file"
  target.write_text("old")
  with pytest.raises(ZeroDivisionError), files.atomic_path(target) as partial:
    partial.write_text("half")
    raise ZeroDivisionError
  assert target.read_text() == "old" and listing(tmp_path) == ["file"]


def test_failed_folder_keeps_the_old_one(tmp_path):
  target = tmp_path / "folder"
  for content in "ab":
    with files.atomic_folder(target) as partial:
      (partial / content).write_text(content)
    assert listing(target) == [content] and listing(tmp_path) == ["folder"]
  with pytest.raises(KeyboardInterrupt), files.atomic_folder(target) as partial:
    (partial / "c").write_text("c")
    raise KeyboardInterrupt
  assert listing(target) == ["b"] and listing(tmp_path) == ["folder"]


def test_a_folder_replaces_a_file_and_a_link_whole(tmp_path):
  kept = tmp_path / "kept"
  kept.mkdir()
  (tmp_path / "file").write_text("old")
  (tmp_path / "link").symlink_to(kept)
  for name in ("file", "link"):
    with files.atomic_folder(tmp_path / name) as partial:
      (partial / "new").write_text("whole")
    assert listing(tmp_path / name) == ["new"]
  assert listing(tmp_path) == ["file", "kept", "link"] and listing(kept) == []


def test_leftovers_of_a_killed_process_are_not_mixed_in(tmp_path):
  target = tmp_path / "folder"
  with files.atomic_folder(target) as partial:
    leftover = partial
  leftover.mkdir()
  (leftover / "stale").write_text("half")
  with files.atomic_folder(target) as partial:
    (partial / "new").write_text("whole")
  assert listing(target) == ["new"] and listing(tmp_path) == ["folder"]


@pytest.mark.parametrize(
  "code, reason", [(errno.ENOSPC, "the disk is full"), (errno.EDQUOT, "the disk quota is used up")]
)
@pytest.mark.parametrize("writer", [files.atomic_path, files.atomic_folder])
def test_full_disk_is_one_line(tmp_path, code, reason, writer):
  target = tmp_path / "target"
  with pytest.raises(files.DiskFullError) as caught, writer(target):
    raise OSError(code, "as the system says")
  again = pickle.loads(pickle.dumps(caught.value))
  for error in (caught.value, again):
    assert str(error) == f"Could not write {target}: {reason}. Free some space and try again."
    assert error.errno == code and files.is_disk_full(error)
  assert listing(tmp_path) == []


def test_the_system_reports_a_full_disk():
  with (
    pytest.raises(files.DiskFullError, match="/dev/full: the disk is full"),
    files.explain_disk_full("/dev/full"),
    open("/dev/full", "wb") as stream,
  ):
    stream.write(b"x")


def test_other_errors_stay_what_they_are(tmp_path):
  with pytest.raises(FileNotFoundError):
    files.write_atomically(tmp_path / "absent" / "file", "x")
  with pytest.raises(PermissionError), files.atomic_path(tmp_path / "file"):
    raise PermissionError("no")
  assert not files.is_disk_full(PermissionError("no"))


def test_what_cannot_be_written_is_named_before_it_is_made(tmp_path):
  kept = tmp_path / "kept.txt"
  kept.write_text("mine")
  files.check_writable(kept)
  files.check_writable(tmp_path / "new.txt")
  assert [path.name for path in tmp_path.iterdir()] == ["kept.txt"] and kept.read_text() == "mine"
  for path in (tmp_path / "none" / "x.glb", tmp_path / ("x" * 300), kept / "x.glb"):
    with pytest.raises(OSError) as found:
      files.check_writable(path)
    assert found.value.filename == str(path)


def test_copies_replace(tmp_path):
  source, target = tmp_path / "source", tmp_path / "target"
  for name in ("one", "two"):
    with files.atomic_folder(source) as folder:
      (folder / name).write_text(name)
    files.copy_atomically(source, target)
    files.copy_atomically(source / name, tmp_path / "file")
    assert listing(target) == [name] and (tmp_path / "file").read_text() == name
  assert listing(tmp_path) == ["file", "source", "target"]


def test_folder_hash_sees_names_and_content(tmp_path):
  (tmp_path / "x").write_text("1")
  before = files.hash_path(tmp_path)
  (tmp_path / "x").rename(tmp_path / "y")
  renamed = files.hash_path(tmp_path)
  (tmp_path / "y").write_text("2")
  assert len({before, renamed, files.hash_path(tmp_path)}) == 3
  with pytest.raises(FileNotFoundError, match="does not exist"):
    files.hash_path(tmp_path / "absent")


def test_hidden_files_do_not_count_and_named_ones_do(tmp_path):
  source, beside = tmp_path / "source", tmp_path / "beside.png"
  source.mkdir()
  (source / "x").write_text("1")
  beside.write_text("2")
  before = files.hash_path(source)
  (source / ".stages").mkdir()
  (source / ".stages" / "y").write_text("3")
  (source / ".DS_Store").write_text("3")
  assert files.hash_path(source) == before == files.hash_path(source, named=[source / "x"])
  for path in (source, source / "x"):
    beside.write_text("2")
    first = files.hash_path(path, named=[beside])
    beside.write_text("3")
    assert len({files.hash_path(path), first, files.hash_path(path, named=[beside])}) == 3


def test_linked_folders_count_and_a_link_to_a_folder_above_does_not(tmp_path):
  capture, linked = tmp_path / "capture", tmp_path / "linked"
  for folder in (capture / "images", linked / "images"):
    folder.mkdir(parents=True)
    (folder / "x").write_text("1")
  plain = files.hash_path(capture)
  shutil.rmtree(capture / "images")
  (capture / "images").symlink_to(linked / "images")
  assert files.hash_path(capture) == plain
  (capture / "again").symlink_to(capture)
  assert files.hash_path(capture) == plain
  (linked / "images" / "y").write_text("2")
  assert files.hash_path(capture) != plain


def test_a_name_that_is_no_utf8_counts(tmp_path):
  odd = tmp_path / os.fsdecode(b"caf\xe9")
  odd.write_text("1")
  first = files.hash_path(tmp_path)
  odd.rename(tmp_path / "café")
  assert len({first, files.hash_path(tmp_path)}) == 2


def test_a_line_is_appended_whole_or_not_at_all(tmp_path):
  path = tmp_path / "lines.jsonl"
  files.append_line(path, "first")
  limit = resource.getrlimit(resource.RLIMIT_FSIZE)
  resource.setrlimit(resource.RLIMIT_FSIZE, (9, limit[1]))
  try:
    with pytest.raises(files.DiskFullError) as caught:
      files.append_line(path, "a line that does not fit")
  finally:
    resource.setrlimit(resource.RLIMIT_FSIZE, limit)
  assert str(path) in str(caught.value) and "limit of a file's size" in str(caught.value)
  assert path.read_text() == "first\n"
  files.append_line(path, "second")
  assert path.read_text() == "first\nsecond\n"
