"""sfm-audit run over an object store: a real S3 server on loopback, what it is asked for, and what goes wrong there."""

import json
import os
import time
from pathlib import Path

import pandas as pd
import pytest
from model_writer import rig_model, text_files, tiny_model, write_binary, write_text
from run_samples import part_times, read_run, write_models
from s3_server import KEYS, S3Server, free_port, s3_server

from sfm_audit.audit.cli.main import main
from sfm_audit.loaders import LoadError, discover, input_files, open_model
from sfm_audit.loaders.datasets.input_state import input_stamp, read_input_state

NAMES = ("0001", "0002", "Zürich 東", "a name with spaces")
MODEL = "0001/sparse/manhattan/0"


@pytest.fixture(scope="module")
def server():
    with s3_server() as server:
        yield server


@pytest.fixture(scope="module")
def source(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("s3") / "data"
    write_models(folder, NAMES)
    for name in NAMES:
        (folder / name / "sparse/0").rename(folder / name / "0")
        (folder / name / "sparse/manhattan").mkdir()
        (folder / name / "0").rename(folder / name / "sparse/manhattan/0")
        (folder / name / "images").mkdir()
        (folder / name / "images/photo.jpg").write_bytes(b"a photo")
    return folder


@pytest.fixture
def bucket(server: S3Server, source, request, monkeypatch, tmp_path):
    """A bucket of the test's own with four models in MegaDepth's layout below data/; credentials in the environment."""
    monkeypatch.chdir(tmp_path)
    for name in list(os.environ):
        if name.startswith("AWS_"):
            monkeypatch.delenv(name)
    for name, value in {**KEYS, "AWS_EC2_METADATA_DISABLED": "true"}.items():
        monkeypatch.setenv(name, value)
    name = f"bucket-{abs(hash(request.node.name)) % 10**9}"
    server.upload(source, f"{name}/data")
    server.requests()
    return name


def one_error(ask) -> str:
    start = time.monotonic()
    with pytest.raises(LoadError) as error:
        ask()
    assert time.monotonic() - start < 30, "retries are bounded"
    assert "\n" not in str(error.value)
    return str(error.value)


def refs(server: S3Server, bucket: str, **options):
    found = discover([server.location(f"{bucket}/data")], **options)
    assert found.errors == ()
    return found.refs


def test_models_are_found_as_in_a_local_folder(server, bucket, source):
    local, remote = discover([source]).refs, refs(server, bucket)
    assert [(ref.dataset, ref.scene, ref.component, ref.num_bytes) for ref in remote] == [
        (ref.dataset, ref.scene, ref.component, ref.num_bytes) for ref in local
    ]
    assert [ref.model_path for ref in remote] == [
        server.location(f"{bucket}/data/{name}/sparse/manhattan/0") for name in NAMES
    ]
    assert len({ref.key for ref in remote}) == 4
    assert all(request["method"] == "GET" and not request["range"] for request in server.requests()), "only listings"
    assert [ref.location for ref in refs(server, bucket, layout="megadepth")] == [ref.location for ref in remote]
    (model,) = discover([server.location(f"{bucket}/data/{MODEL}/")]).refs
    assert (model.scene, model.component, model.key) == ("0001", "0", remote[0].key)


def test_a_model_is_what_it_is_in_a_local_folder(server, bucket, tmp_path):
    for number, write in enumerate((write_binary, write_text)):
        folder = write(tmp_path / str(number), rig_model())
        server.upload(folder, f"{bucket}/rigs/{number}")
        location = server.location(f"{bucket}/rigs/{number}")
        local, remote = open_model(folder), open_model(location)
        assert (remote.location, remote.file_format, remote.findings) == (location, local.file_format, local.findings)
        assert (remote.images.name, len(remote.points)) == (local.images.name, len(local.points))
        assert (remote.observations.xy_px == local.observations.xy_px).all()
        assert [(file.name, file.num_bytes) for file in input_files(location)] == [
            (file.name, file.num_bytes) for file in input_files(folder)
        ]


def test_text_beside_binary_is_compared(server, bucket, tmp_path):
    folder = write_binary(tmp_path / "both", tiny_model())
    for name, content in text_files(tiny_model().but(points=())).items():
        (folder / name).write_bytes(content)
    server.upload(folder, f"{bucket}/both")
    assert open_model(server.location(f"{bucket}/both")).findings == open_model(folder).findings != ()


@pytest.mark.parametrize("jobs", ["1", "2"])
def test_a_run_has_the_rows_of_a_local_one(server, bucket, source, jobs, capsys):
    assert main(["run", server.location(f"{bucket}/data"), "-o", "REMOTE", "--quiet", "--jobs", jobs]) == 0
    assert main(["run", str(source), "-o", "LOCAL", "--quiet", "--jobs", "1"]) == 0
    assert capsys.readouterr() == ("", "")
    remote, local = read_run(Path("REMOTE")), read_run(Path("LOCAL"))
    for name in ("images", "models"):
        keys = [("scene", "ascending"), *([("image_id", "ascending")] if name == "images" else [])]
        columns = [column for column in local[name].column_names if column != "model_path"]
        assert remote[name].select(columns).sort_by(keys).equals(local[name].select(columns).sort_by(keys))
    inputs = [json.loads(line) for line in Path("REMOTE/manifest.jsonl").read_text(encoding="utf-8").splitlines()]
    assert all(entry["model_path"].startswith("s3://") for entry in inputs)


def test_list_fetches_no_models(server, bucket, capsys):
    assert main(["run", server.location(f"{bucket}/data"), "--list"]) == 0
    rows = [line.split("\t") for line in capsys.readouterr().out.splitlines()]
    assert [row[:4] for row in rows] == [["data", name, "0", "5"] for name in NAMES]
    ranges = [request["range"] for request in server.requests() if request["range"]]
    assert len(ranges) == 4
    assert all(int(each.rpartition("-")[2]) < 4096 for each in ranges)


def test_a_second_run_asks_for_listings_only(server, bucket):
    args = ["run", server.location(f"{bucket}/data"), "-o", "RUN", "--quiet", "--jobs", "1"]
    assert main(args) == 0
    before = part_times(Path("RUN"))
    requests = server.requests()
    fetched = [request["path"] for request in requests if request["range"]]
    assert len(fetched) == len(set(fetched)) == 4 * 5, "every file of every model once"
    assert not any("photo" in path for path in fetched)
    server.requests()
    assert main(args) == 0
    assert part_times(Path("RUN")) == before
    assert all(request["method"] == "GET" and not request["range"] for request in server.requests())


def test_what_changed_is_audited_again(server, bucket, source):
    args = ["run", server.location(f"{bucket}/data"), "-o", "RUN", "--quiet", "--jobs", "1"]
    assert main(args) == 0
    before = part_times(Path("RUN"))
    content = (source / "0002/sparse/manhattan/0/images.bin").read_bytes()
    time.sleep(1.1)  # S3 tells times in seconds
    for name in ("cameras", "points3D"):  # the same content at a later time
        server.put(f"{bucket}/data/{MODEL}/{name}.bin", (source / MODEL / f"{name}.bin").read_bytes())
    location = refs(server, bucket)[0].location
    assert main(args) == 0
    assert part_times(Path("RUN")) == before
    server.put(f"{bucket}/data/{MODEL}/images.bin", content)
    state = read_input_state(location)
    assert state.stamp == input_stamp(location) == refs(server, bucket)[0].stamp
    assert main(args) in {0, 3}, "another model's images"
    assert part_times(Path("RUN")) != before


def test_a_broken_model_costs_one_line(server, bucket, source, capsys):
    content = (source / "0002/sparse/manhattan/0/points3D.bin").read_bytes()
    server.put(f"{bucket}/data/0002/sparse/manhattan/0/points3D.bin", content[:-7])
    server.put(f"{bucket}/data/{MODEL}/images.bin", b"")
    server.delete(f"{bucket}/data/a name with spaces/sparse/manhattan/0/cameras.bin")
    assert main(["run", server.location(f"{bucket}/data"), "-o", "RUN", "--jobs", "1"]) == 3
    err = capsys.readouterr().err
    assert err.count("\n") == 3
    assert f"s3://{bucket}/data/0002/sparse/manhattan/0/points3D.bin{server.options.split('&')[0]}" in err
    assert "found an empty file" in err
    assert "add cameras.bin" in err
    assert list(pd.read_parquet("RUN/models")["scene"]) == ["Zürich 東"]


@pytest.mark.parametrize("num_reads", [0, 1, 2])
def test_a_file_that_vanishes_while_the_model_is_read_is_named(server, bucket, num_reads):
    ref = refs(server, bucket)[0]
    name = "points3D.bin" if num_reads == 2 else "images.bin"
    server.delete_after(num_reads, f"{bucket}/data/{MODEL}/{name}")
    message = one_error(lambda: open_model(ref.location))
    assert f"{MODEL}/{name}" in message
    assert "expected a file, found nothing; it was removed since the folder was listed" in message


def test_a_model_that_vanishes_after_it_was_found_costs_one_line(server, bucket):
    ref = refs(server, bucket)[0]
    for file in input_files(ref.location):
        server.delete(f"{bucket}/data/{MODEL}/{file.name}")
    message = one_error(lambda: open_model(ref.location))
    assert "found none of them" in message or "found nothing" in message, "stores differ in what is left of a folder"
    assert input_stamp(ref.location) == ""


@pytest.mark.parametrize(
    ("place", "text"),
    [
        ("no-such-bucket/data", "no bucket of that name (NO_SUCH_BUCKET); check its name, and endpoint_override"),
        ("no-such-bucket", "no bucket of that name"),
        ("BUCKET/nowhere", "expected a folder, found nothing"),
        ("BUCKET/data/0001/images/photo.jpg", "found a file"),
        ("BUCKET/data/0001/images", "found no file of a model (binary, text, "),
    ],
)
def test_a_wrong_path_costs_one_line_and_3(server, bucket, place, text, capsys):
    location = server.location(place.replace("BUCKET", bucket))
    assert main(["run", location, server.location(f"{bucket}/data/0001"), "-o", "RUN"]) == 3
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert err.startswith(f"sfm-audit: {location}: ")
    assert text in err
    assert len(pd.read_parquet("RUN/models")) == 1


def test_a_server_that_is_not_there_is_told_in_time(bucket):
    nobody = f"?endpoint_override=127.0.0.1:{free_port()}&scheme=http"
    (error,) = discover([f"s3://{bucket}/data{nobody}"]).errors
    assert "expected an answer of the object store, found none (NETWORK_CONNECTION, " in str(error)
    assert "check the network" in str(error)
    assert "found none" in one_error(lambda: open_model(f"s3://{bucket}/data/{MODEL}{nobody}"))


def test_failed_requests_are_repeated_a_bounded_number_of_times(server, bucket):
    location = refs(server, bucket)[0].location
    server.fail(2)
    assert len(open_model(location).images) == 5
    server.requests()
    server.fail(1000)
    assert "an answer of the object store" in one_error(lambda: open_model(location))
    server.fail(0)
    assert len(server.requests()) <= 10


def test_public_buckets_need_no_credentials(server, bucket, source, monkeypatch, capsys):
    for name in KEYS:
        monkeypatch.delenv(name)
    public = server.location(f"{bucket}/data") + "&anonymous=true"
    server.requests()
    assert main(["run", public, "-o", "RUN", "--quiet", "--jobs", "1"]) == 0
    assert {request["is_signed"] for request in server.requests()} == {"False"}
    private = f"private-{bucket}"
    server.upload(source / "0001", f"{private}/data/0001")
    for options, advice in (("", "say ?anonymous=true"), ("&anonymous=true", "leave out anonymous=true")):
        assert main(["run", server.location(f"{private}/data") + options, "-o", "OTHER"]) == 3
        err = capsys.readouterr().err
        assert err.count("\n") == 1
        assert "access denied (ACCESS_DENIED)" in err
        assert advice in err
    for name, value in KEYS.items():
        monkeypatch.setenv(name, value)
    assert len(discover([server.location(f"{private}/data") + "&scheme=http"]).refs) == 1


def test_a_run_folder_is_bound_to_what_was_named(server, bucket, tmp_path, monkeypatch, capsys):
    one, two = (server.location(f"{bucket}/data/{name}") for name in NAMES[:2])
    assert main(["run", one, "-o", str(tmp_path / "RUN"), "--quiet"]) == 0
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert main(["run", two, "-o", str(tmp_path / "RUN"), "--quiet"]) == 2
    assert "which this command leaves out" in capsys.readouterr().err
    assert main(["run", one, two, "-o", str(tmp_path / "RUN"), "--quiet"]) == 0


def test_keypoint_sizes_are_not_fetched(server, bucket, capsys):
    location = server.location(f"{bucket}/data/0001")
    assert main(["run", location, "-o", "RUN", "--noise", "keypoint", "--jobs", "1"]) == 3
    assert "copy the scene, or use --noise track" in capsys.readouterr().err
