"""The packaged tables against a small simulation, and whether that check would notice a wrong table."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

from sfm_audit.audit.normality import null_tables
from sfm_audit.audit.normality.null_tables import NullTable, QuantileTable, load

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "make_null_tables.py"


@pytest.fixture(scope="module")
def script():
    spec = importlib.util.spec_from_file_location("make_null_tables", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["make_null_tables"] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules["make_null_tables"]


def test_packaged_tables_agree_with_a_small_simulation(script):
    for table in NullTable:
        assert script.disagreements(table, 4000, seed=1) == []


@pytest.mark.parametrize("table", list(NullTable))
def test_a_wrong_table_is_noticed(script, monkeypatch, table):
    data = load(table)
    wrong = QuantileTable(data.num_values, data.p, 1.04 * data.quantile)
    null_tables._curve.cache_clear()
    monkeypatch.setattr(null_tables, "load", lambda _: wrong)
    try:
        assert script.disagreements(table, 4000, seed=1) != []
    finally:
        null_tables._curve.cache_clear()


def test_a_table_is_made_bit_for_bit(script, monkeypatch):
    levels = np.array([0.9, 0.5, 0.1, 0.05, 0.01])
    monkeypatch.setattr(script, "P_LEVELS", levels)
    monkeypatch.setattr(script, "SIZES", (2, 3, 5, 12, 20, 50, 100, 200))
    first, second = (script.make(NullTable.KS_NORM, 4000, seed=2) for _ in range(2))
    assert first == second
    assert script.make(NullTable.KS_NORM, 4000, seed=3) != first
    rows = [line.split(",") for line in first.splitlines() if not line.startswith("#")]
    assert [row[0] for row in rows] == ["0", "2", "3", "5", "12", "20", "50", "100", "200", "inf"]
    assert [float(p) for p in rows[0][1:]] == levels.tolist()
    assert all(1.07 < float(row[4]) < 1.12 for row in rows[3:-1])  # the 5 % points


def test_tables_name_their_origin(script):
    for table in NullTable:
        text = (script.FOLDER / f"{table.value}.csv").read_text()
        assert text.startswith(f"# scripts/make_null_tables.py --seed {script.SEED} --draws {script.DRAWS} ")
        assert len(text) < 100_000
