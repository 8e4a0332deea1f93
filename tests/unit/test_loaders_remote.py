"""What is said of what an object store objects to; tests/e2e/test_s3.py asks a real server."""

import pyarrow.fs
import pytest

from sfm_audit.loaders import LoadError, MissingFileError, UnreadableFileError, discover, open_model
from sfm_audit.loaders.paths import remote

S3 = "When listing objects under key 'x/' in bucket 'b': AWS Error {} during ListObjectsV2 operation: {}"
GS = "google::cloud::Status({}: {} error_info={{reason=, domain=, metadata={{}}}})"
MESSAGES = [
    ("s3", S3.format("UNKNOWN (HTTP status 301)", "The bucket is in this region"), UnreadableFileError, "say ?region="),
    (
        "s3",
        S3.format("INVALID_SIGNATURE", "no"),
        UnreadableFileError,
        "(INVALID_SIGNATURE); check the credentials (AWS_",
    ),
    ("s3", S3.format("EXPIRED_TOKEN", "The token"), UnreadableFileError, "access denied (EXPIRED_TOKEN)"),
    ("s3", "Bucket 'b' not found", MissingFileError, "no bucket of that name"),
    ("s3", "something\nnew", UnreadableFileError, "found something new; give the same command again"),
    (
        "gs",
        GS.format("PERMISSION_DENIED", "Caller has no access"),
        UnreadableFileError,
        "(GOOGLE_APPLICATION_CREDENTIALS)",
    ),
    ("gs", GS.format("UNAVAILABLE", "try later"), UnreadableFileError, "found none (UNAVAILABLE)"),
]


class Objecting:
    """A file system that has one answer."""

    def __init__(self, error: Exception) -> None:
        self.error = error

    def get_file_info(self, _):
        raise self.error

    open_input_file = get_file_info


@pytest.fixture
def objecting(monkeypatch: pytest.MonkeyPatch):
    def answer(error: Exception) -> None:
        monkeypatch.setattr(remote, "_connect", lambda *_: Objecting(error))

    return answer


@pytest.mark.parametrize(("scheme", "message", "kind", "text"), MESSAGES)
def test_every_objection_is_one_line_that_says_what_to_do(objecting, scheme, message, kind, text):
    objecting(OSError(message))
    location = f"{scheme}://b/x"
    with pytest.raises(kind) as error:
        open_model(location)
    (problem,) = discover([location]).errors
    for each in (error.value, problem):
        assert isinstance(each, LoadError)
        assert each.path == location
        assert text in str(each)
        assert "\n" not in str(each)


@pytest.mark.parametrize("store", ["S3FileSystem", "GcsFileSystem"])
def test_a_pyarrow_without_the_store_is_told(store, monkeypatch: pytest.MonkeyPatch):
    def absent(**_):
        raise ImportError("The pyarrow installation is not built with support for it")

    monkeypatch.setattr(pyarrow.fs, store, absent)
    location = "s3://bucket/x?region=nowhere" if store.startswith("S3") else "gs://bucket/x"
    with pytest.raises(UnreadableFileError, match="a pyarrow without support"):
        open_model(location)


def test_a_bug_stays_a_bug(objecting):
    objecting(ValueError("a bug"))
    with pytest.raises(ValueError, match="a bug"):
        open_model("s3://b/x")
