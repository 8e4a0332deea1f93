"""A run goes on where it stopped: another database, reference or priors under the same name makes its models stale."""

from __future__ import annotations

import os
import sqlite3
from contextlib import closing

import pyarrow.parquet as pq
import pytest
from model_writer import noisy_model, write_binary, write_text

from sfm_audit.audit.cli.main import main
from sfm_audit.loaders.references.state import evidence_state


@pytest.fixture
def folder(tmp_path):
    return write_binary(tmp_path / "scene" / "sparse" / "0", noisy_model())


def audited(folder, out, *options):  # noqa: ANN002
    """Run, and say when the images of the run were written."""
    assert main(["run", str(folder), "-o", str(out), "--quiet", *options]) == 0
    (part,) = (out / "images").iterdir()
    return part.stat().st_mtime_ns, pq.read_table(part)


def test_a_changed_reference_is_noticed_and_a_touched_one_is_not(tmp_path, folder):
    names = [image.name for image in noisy_model().images]
    path = tmp_path / "priors.csv"
    path.write_text("name,x,y,z\n" + "".join(f"{name},{i},0,0\n" for i, name in enumerate(names)))
    reference = write_text(tmp_path / "reference", noisy_model())
    options = ("--reference", str(reference), "--priors", str(path))
    first, table = audited(folder, tmp_path / "out", *options)
    assert "reference_centre_rel" in table.column_names
    assert "prior_chi2" in table.column_names
    os.utime(path, ns=(1, 1))
    assert audited(folder, tmp_path / "out", *options)[0] == first
    path.write_text(path.read_text().replace(",0,0\n", ",0,1\n"))
    second, _ = audited(folder, tmp_path / "out", *options)
    assert second > first
    write_text(reference, noisy_model(1))
    third, _ = audited(folder, tmp_path / "out", *options)
    assert third > second
    assert audited(folder, tmp_path / "out", *options)[0] == third


def test_the_state_of_what_was_named(tmp_path, folder):
    """Empty without, other with a database, other when that changes, and said where it cannot be read."""

    def state(database=None, reference=None, priors=None, below=""):
        return evidence_state(str(folder), below, database, reference, priors)

    assert state() == ""
    none = state("auto")
    with closing(sqlite3.connect(tmp_path / "scene" / "database.db")) as db:
        db.execute("CREATE TABLE images (image_id, name)")
    there = state("auto")
    assert there != none
    assert there == state("auto")
    assert there != state(priors="auto")
    with closing(sqlite3.connect(tmp_path / "scene" / "database.db")) as db:
        db.execute("INSERT INTO images VALUES (1, 'a')")
        db.commit()
    assert state("auto") != there
    assert state(reference=str(tmp_path / "nothing")) == state(reference=str(tmp_path / "nothing"))
    tree = write_text(tmp_path / "tree" / "0", noisy_model())
    in_tree = state(reference=str(tree.parent), below="0")
    assert in_tree != state(reference=str(tree.parent), below="1")
    (tree / "points3D.txt").write_text("# Number of points: 0\n")
    assert state(reference=str(tree.parent), below="0") != in_tree
    assert len({state(reference=str(tmp_path / "nothing")), state("none.db"), none, there}) == 4


def test_a_reference_that_cannot_be_read_fails_the_model(tmp_path, folder, capsys):
    path = tmp_path / "bad.txt"
    path.write_text("1 2 3\n")
    assert main(["run", str(folder), "-o", str(tmp_path / "out"), "--quiet", "--reference", str(path)]) == 3
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "expected a COLMAP model, images.txt, a TUM" in said


def test_a_reference_that_is_not_there_is_said_once(tmp_path, folder, capsys):
    for option in ("--reference", "--priors"):
        options = ["-o", str(tmp_path / "out"), option, str(tmp_path / "nothing")]
        assert main(["run", str(folder), *options]) == 3
        assert capsys.readouterr().err.count("there is no such file") == 1
        assert not (tmp_path / "out").exists()


def test_two_nights_with_other_references_are_compared_as_they_are(tmp_path, folder, capsys):
    for night, seed in (("one", 1), ("two", 2)):
        reference = write_text(tmp_path / f"reference {night}", noisy_model(seed))
        audited(folder, tmp_path / night, "--reference", str(reference))
    capsys.readouterr()
    assert main(["diff", str(tmp_path / "one"), str(tmp_path / "two")]) == 0
    gate = tmp_path / "gate.toml"
    gate.write_text("")
    code = main(["check", str(tmp_path / "two"), "--baseline", str(tmp_path / "one"), "--policy-file", str(gate)])
    said = capsys.readouterr()
    assert (code, said.err) == (0, "")
    assert "decided again" not in said.out
