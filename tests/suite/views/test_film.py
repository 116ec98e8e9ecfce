"""Films of tasks as files."""

import pytest

from nerf2real.suite.views import film


@pytest.mark.parametrize("suffix", [".mp4", ".webp"])
def test_a_file_that_cannot_be_written_is_named_before_anything_is_rendered(tmp_path, suffix):
  path = tmp_path / f"{'x' * 300}{suffix}"
  with pytest.raises(OSError, match="too long") as found, film.open_film(path):
    pytest.fail("opened")
  assert found.value.filename == str(path)
  assert list(tmp_path.iterdir()) == []
