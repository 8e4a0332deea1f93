"""What a location string names, and that it comes back as it went in."""

import os
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfm_audit.loaders import MissingFileError, UnreadableFileError, discover, open_model
from sfm_audit.loaders.colmap.database import find_database
from sfm_audit.loaders.paths.locations import RemotePath, below, parse_location, real_location

names = st.text(st.characters(exclude_characters="/?&@", exclude_categories=["Cs"]), min_size=1).filter(
    lambda name: name not in {".", ".."}
)


def test_parts_and_options():
    path = parse_location("s3://bucket/a b//c%20d/?scheme=http&anonymous=true&endpoint_override=localhost:9000")
    assert isinstance(path, RemotePath)
    assert (path.scheme, path.parts, path.key) == ("s3", ("bucket", "a b", "c%20d"), "bucket/a b/c%20d")
    assert path.options == (("anonymous", "true"), ("endpoint_override", "localhost:9000"), ("scheme", "http"))
    assert str(path) == "s3://bucket/a b/c%20d?anonymous=true&endpoint_override=localhost:9000&scheme=http"
    child = path / "images.bin"
    assert (child.name, child.stem, child.options, child.folder) == ("images.bin", "images", path.options, path)


@pytest.mark.parametrize("location", ["data", "./data", "/data/s3:/x", "C:/data", Path("data")])
def test_what_is_no_uri_is_a_path(location):
    assert parse_location(location) == Path(location)


def test_a_question_mark_in_a_key_is_no_query():
    assert parse_location("s3://bucket/what?/0").parts == ("bucket", "what?", "0")
    assert parse_location("gs://bucket/what?/0?anonymous=true").parts == ("bucket", "what?", "0")


@pytest.mark.parametrize(
    ("location", "text"),
    [
        ("hdfs://host/x", "found hdfs://"),
        ("https://host/x", "found https://"),
        ("s3://", "found no bucket"),
        ("s3://?anonymous=true", "found no bucket"),
        ("s3://bucket/x?anonymus=true", "found anonymus=; known are anonymous, region"),
        ("s3://bucket/x?anonymous=yes", "found anonymous=yes"),
        ("gs://bucket/x?region=here", "found region="),
    ],
)
def test_what_cannot_be_meant_is_refused(location, text):
    for ask in (parse_location, open_model):
        with pytest.raises(UnreadableFileError) as error:
            ask(location)
        assert text in str(error.value)
    (problem,) = discover([location]).errors
    assert text in str(problem)


@pytest.mark.parametrize("location", ["s3://KEY:SECRET@bucket/x", "s3://bucket/x?secret_key=SECRET"])
def test_secrets_are_refused_and_not_repeated(location):
    with pytest.raises(UnreadableFileError) as error:
        parse_location(location)
    assert "SECRET" not in str(error.value).replace("AWS_SECRET_ACCESS_KEY", "")
    assert "AWS_SECRET_ACCESS_KEY" in str(error.value)


@given(parts=st.lists(names, min_size=1, max_size=4), query=st.sampled_from(["", "?anonymous=true&region=a-b"]))
def test_a_location_comes_back(parts, query):
    location = below(f"s3://bucket{query}", parts)
    path = parse_location(location)
    assert (path.parts, str(path)) == (("bucket", *parts), location)
    assert real_location(location) == location


def test_below_keeps_what_was_typed(tmp_path: Path):
    assert below("./d/", ("s", "0")) == "./d/s/0"
    assert below("s3://b/d/?region=x", ("s", "0")) == "s3://b/d/s/0?region=x"
    assert below("s3://b/d/?region=x", ()) == "s3://b/d/?region=x"
    assert real_location(tmp_path / "x" / ".." / "y") == os.path.realpath(tmp_path / "y")


def test_a_database_in_an_object_store_is_refused(tmp_path: Path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("database.db").touch()
    with pytest.raises(UnreadableFileError, match="use --noise track"):
        find_database("s3://bucket/x/sparse/0")


def test_a_link_to_nothing_is_nothing(tmp_path: Path):
    (tmp_path / "link").symlink_to(tmp_path / "gone")
    (error,) = discover([tmp_path / "link"]).errors
    assert isinstance(error, MissingFileError)
