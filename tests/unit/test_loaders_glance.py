"""The number of images of a model that is not loaded."""

import struct
from pathlib import Path

import pytest
from corpus import parametrize_models
from model_writer import tiny_model, write_binary, write_text

from sfm_audit.loaders import LoadError, MissingFileError, TruncatedFileError, open_model
from sfm_audit.loaders.datasets.image_counts import count_images, count_images_of


@pytest.mark.parametrize("write", [write_binary, write_text])
def test_the_number_is_that_of_the_model(tmp_path: Path, write):
    folder = write(tmp_path / "m", tiny_model())
    assert count_images(str(folder)) == len(open_model(folder).images) > 0


def test_what_cannot_be_told_is_an_error(tmp_path: Path):
    folder = write_binary(tmp_path / "m", tiny_model())
    for content, kind in ((b"", TruncatedFileError), (b"1234567", TruncatedFileError), (b"", TruncatedFileError)):
        (folder / "images.bin").write_bytes(content)
        with pytest.raises(kind):
            count_images(str(folder))
    (folder / "images.bin").write_bytes(struct.pack("<Q", 1000) + bytes(100))
    with pytest.raises(TruncatedFileError, match="1000 images"):
        count_images(str(folder))
    other = write_text(tmp_path / "other", tiny_model())
    broken, fine, missing = count_images_of([str(folder), str(other), str(tmp_path / "gone")])
    assert isinstance(broken, LoadError)
    assert fine == len(open_model(other).images)
    assert isinstance(missing, MissingFileError)


@parametrize_models()
def test_the_number_is_that_of_real_models(model_dir: Path):
    assert count_images(str(model_dir)) == len(open_model(model_dir).images)
