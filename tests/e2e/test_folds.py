"""A folded reconstruction of a symmetric building: does a gate with an empty file fail on it, and say why?"""

import json
import shutil
from pathlib import Path

import pytest
from corpus import FOLDS, needs_folds

from sfm_audit.audit.cli.main import main

pytestmark = [pytest.mark.corpus, needs_folds]


@pytest.mark.parametrize("name", ["ring_301", "uneven_302"])
def test_a_gate_fails_on_a_fold_and_passes_its_twin(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("empty.toml").touch()
    assert main(["run", str(FOLDS / "gate" / name / "baseline" / "scene"), "-o", "R0", "--quiet"]) == 0
    for kind in ("fold", "twin"):
        shutil.copytree(FOLDS / f"{kind}_{name}", Path(kind, "scene"))
        assert main(["run", f"{kind}/scene", "-o", f"R_{kind}", "--quiet"]) == 0
    capsys.readouterr()
    check = ["check", "--baseline", "R0", "--policy-file", "empty.toml", "--json", "out.json"]
    assert main([*check, "R_twin"]) == 0
    assert main([*check, "R_fold"]) == 1
    failed = {c["check"]: c for c in json.loads(Path("out.json").read_text())["checks"] if not c["passed"]}
    assert failed.keys() == {"band.fragments", "band.moved_images"}
    truth = json.loads((FOLDS / f"fold_{name}" / "truth.json").read_text())["images"]
    turned = {image for image, said in truth.items() if said["side"] == "turned"}
    assert {image["image_name"] for image in failed["band.fragments"]["images"]} == turned
    assert f"fold: {len(turned)} images turned together by 180.0 deg" in failed["band.fragments"]["message"]
    shown = " ".join(capsys.readouterr().out.split())
    assert "scene/scene band.fragments: fold:" in shown
    assert all(f"scene/scene/{image}" in shown for image in sorted(turned)[:12])
