"""pycolmap before Pillow aborts a process that saves a PNG: both bring a zlib. Pillow first, or our figures, do not."""

import importlib.util
import subprocess
import sys

import pytest

SAVES = "from PIL import Image; import io; Image.new('RGB', (300, 300)).save(io.BytesIO(), 'PNG'); print('saved')"
pytestmark = pytest.mark.skipif(importlib.util.find_spec("PIL") is None, reason="needs the extra report")


@pytest.mark.parametrize("first", ["import PIL.Image, pycolmap", "import sfm_audit.reports.figures, pycolmap"])
def test_with_pillow_first_a_process_lives(first):
    done = subprocess.run([sys.executable, "-c", f"{first}; {SAVES}"], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "saved\n")
