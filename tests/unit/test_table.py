import pickle
import subprocess
import sys
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st
from run_samples import sample_table

from sfm_audit.audit.table import CAMERAS, IMAGES, MODELS, OBSERVATIONS, TABLES, arrow, build_table, empty_table, schema
from sfm_audit.loaders.model import Finding, FindingCode

GROUPS = ("radial", "tangential", "affine", "principal_point", "rolling_shutter", "smooth")
MISFIT = " ".join(f"misfit_{group}_{what}" for group in GROUPS for what in ("p", "px", "rank"))
MISFIT += " misfit_group misfit_px misfit_q advised_camera_model"

# the contract of DESIGN
DESIGN_IMAGES = f"""
dataset scene component model_path image_id image_name camera_id camera_model width height params
num_points2d num_linked num_inliers num_behind num_nonfinite num_dangling num_unverifiable num_standardised
mean_track_length coverage occupied_cells rms_px mean_px median_px p95_px max_px
noise_model sigma_constant_px sigma_d_px sigma_l sigma_predicted_px scale_ratio noise_converged
ks_stat ks_p ks_q ks_fitted_p ks_norm_p ks_norm_unscaled_p dap_stat dap_p sw_stat sw_p skewness kurtosis_excess
ks_constant_stat ks_constant_p kurtosis_constant {MISFIT}
pose_offset_px sd_focal_px sd_focal_rel sd_k1 focal_over_size folds_over expected_error_px
verdict verdict_ks verdict_misfit verdict_pose plausible reasons
"""
DESIGN_CAMERAS = f"""
dataset scene component model_path camera_id camera_model num_images num_points3d {MISFIT}
"""
DESIGN_MODELS = """
dataset scene component model_path num_images num_points3d stored_error_px recomputed_point_error_px
recomputed_observation_error_px num_accepted num_rejected num_undetermined
num_accepted_ks num_rejected_ks num_undetermined_ks num_accepted_misfit num_rejected_misfit num_undetermined_misfit
num_accepted_pose num_rejected_pose num_undetermined_pose
num_accepted_plausible num_rejected_plausible num_undetermined_plausible findings
"""
TEXT = {
    *("dataset", "scene", "component", "model_path", "image_name", "camera_model", "noise_model", "file_format"),
    *("verdict", "verdict_ks", "verdict_misfit", "verdict_pose", "plausible", "misfit_group", "advised_camera_model"),
    *("verdict_camera", "verdict_noise", "verdict_outside", "severity", "sd_neighbour"),
}


@pytest.mark.parametrize(
    ("name", "contract"), [("images", DESIGN_IMAGES), ("cameras", DESIGN_CAMERAS), ("models", DESIGN_MODELS)]
)
def test_columns_are_design_s_in_design_s_order(name, contract):
    ours = [column.name for column in TABLES[name]]
    assert [column for column in ours if column in contract.split()] == contract.split()
    assert len(set(ours)) == len(ours)


@pytest.mark.parametrize("column", [*IMAGES, *CAMERAS, *MODELS], ids=lambda column: column.name)
def test_types_are_design_s(column):  # noqa: C901 # one branch per kind of column
    if column.name in {"image_id", "camera_id", "width", "height"}:
        wanted = pa.uint32()
    elif (
        column.name.startswith("num_")
        or column.name.endswith(("_rank", "_rank_joint"))
        or column.name in {"occupied_cells", "joint_blocks", "own_num_images", "covisible_part", "fold_group"}
    ):
        wanted = pa.int64()
    elif column.name in {"noise_converged", "folds_over", "misfit_material", "half_pixel", "is_articulation"}:
        wanted = pa.bool_()
    elif column.name in TEXT:
        wanted = pa.string()
    elif column.name in {"params", "own_correlations", "pose_sds", "pose_correlations"}:
        wanted = pa.list_(pa.float64())
    elif column.name in {"reasons", "witnesses", "own_parameters"}:
        wanted = pa.list_(pa.string())
    elif column.name == "reason_details":
        numbers, texts = ("value", "limit"), ("code", "verdict", "unit", "group", "text")
        fields = dict.fromkeys(texts, pa.string()) | dict.fromkeys(numbers, pa.float64())
        order = ("code", "verdict", "value", "limit", "unit", "group", "text")
        wanted = pa.list_(pa.struct({name: fields[name] for name in order}))
    elif column.name == "testimonies":
        numbers, texts = ("score", "limit", "q"), ("unit", "text")
        kinds = {"witness": pa.string(), **dict.fromkeys(numbers, pa.float64()), **dict.fromkeys(texts, pa.string())}
        wanted = pa.list_(pa.struct(kinds))
    elif column.name == "misfit_details":
        numbers = ("gain", "worth_deg", "worth_centre", "worth_focal_rel")
        texts = ("group", "status")
        wanted = pa.list_(pa.struct({**dict.fromkeys(texts, pa.string()), **dict.fromkeys(numbers, pa.float64())}))
    elif column.name == "diagnoses":
        kinds = dict.fromkeys(("text", "action", "command"), pa.string())
        first = {"code": pa.string(), "camera_id": pa.uint32(), "severity": pa.string(), "num_images": pa.int64()}
        wanted = pa.list_(pa.struct({**first, "examples": pa.list_(pa.string()), **kinds}))
    elif column.name == "findings":
        wanted = pa.list_(pa.struct({"code": pa.string(), "count": pa.int64(), "text": pa.string()}))
    else:
        wanted = pa.float64()
    assert column.type == wanted


@pytest.mark.parametrize("column", [*IMAGES, *CAMERAS, *MODELS, *OBSERVATIONS], ids=lambda column: column.name)
def test_every_column_says_its_unit_and_meaning(column):
    assert column.unit
    assert column.meaning
    assert "\n" not in column.meaning
    assert not column.name.endswith("_px") or column.unit == "px"


SMALL = pa.schema(
    [
        ("id", pa.uint32()),
        ("count", pa.int64()),
        ("px", pa.float64()),
        ("flag", pa.bool_()),
        ("name", pa.string()),
        ("numbers", pa.list_(pa.float64())),
        ("names", pa.list_(pa.string())),
        ("findings", schema("models").field("findings").type),
    ]
)
FINDING = Finding(FindingCode.EMPTY_MODEL, 3, "three")


def small(**changes: Any):
    columns = {
        "id": np.array([4_000_000_000, 2, 3]),
        "count": np.ma.masked_array([1, 2, 3], [False, True, False]),
        "px": np.array([0.5, np.nan, np.inf]),
        "flag": [True, None, False],
        "name": ["a", None, "Zürich 東"],
        "numbers": [[1.0, np.nan], None, np.array([])],
        "names": [["a", None], [], None],
        "findings": [[FINDING], [], None],
    }
    return {**columns, **changes}


def test_values_and_nulls():
    table = build_table(small(), SMALL)
    table.validate(full=True)
    rows = table.to_pylist()
    assert [row["id"] for row in rows] == [4_000_000_000, 2, 3]
    assert [row["count"] for row in rows] == [1, None, 3]
    assert [row["px"] for row in rows] == [0.5, None, None]  # never an infinity
    assert [row["flag"] for row in rows] == [True, None, False]
    assert [row["name"] for row in rows] == ["a", None, "Zürich 東"]
    assert rows[0]["numbers"][0] == 1.0
    assert np.isnan(rows[0]["numbers"][1])
    assert [row["numbers"] for row in rows[1:]] == [None, []]
    assert [row["names"] for row in rows] == [["a", None], [], None]
    assert [row["findings"] for row in rows] == [[{"code": "empty_model", "count": 3, "text": "three"}], [], None]


@given(
    st.lists(
        st.tuples(
            st.none() | st.integers(-(2**63), 2**63 - 1),
            st.none() | st.floats(allow_nan=False, allow_infinity=False),
            st.none() | st.booleans(),
            st.none() | st.text(st.characters(exclude_categories=["Cs"])),
            st.none() | st.lists(st.none() | st.text(st.characters(exclude_categories=["Cs"]))),
        )
    )
)
def test_what_goes_in_comes_out_as_through_pyarrow(rows):
    fields = [
        ("i", pa.int64()),
        ("f", pa.float64()),
        ("b", pa.bool_()),
        ("s", pa.string()),
        ("l", pa.list_(pa.string())),
    ]
    columns = {name: [row[i] for row in rows] for i, (name, _) in enumerate(fields)}
    ours = build_table(columns, pa.schema(fields))
    ours.validate(full=True)
    assert ours.equals(pa.table(columns, schema=pa.schema(fields)))


@pytest.mark.parametrize("name", ["images", "cameras", "models"])
def test_parquet_keeps_types_units_and_meanings(tmp_path, name):
    pq.write_table(sample_table(name, 2), tmp_path / "t.parquet")
    read = pq.ParquetFile(tmp_path / "t.parquet").read()
    assert read.schema.equals(schema(name), check_metadata=True)
    frame = pd.read_parquet(tmp_path / "t.parquet")
    assert list(frame.columns) == [column.name for column in TABLES[name]]


def test_a_name_that_is_no_unicode_is_shown_by_its_code():
    table = build_table(small(name=["\udcff.jpg", "b", "c"]), SMALL)
    table.validate(full=True)
    assert table["name"][0].as_py() == r"\udcff.jpg"


def test_empty_tables_have_the_schema():
    table = empty_table("images")
    table.validate(full=True)
    assert (table.num_rows, table.schema) == (0, schema("images"))


@pytest.mark.parametrize(
    ("changes", "error", "words"),
    [
        ({"count": [1.0, 2.0, 3.0]}, TypeError, "column count: expected int64, found float64"),
        ({"count": [True, False, True]}, TypeError, "column count"),
        ({"flag": [1, 0, 1]}, TypeError, "column flag"),
        ({"px": ["a", "b", "c"]}, TypeError, "column px"),
        ({"id": [-1, 2, 3]}, ValueError, "column id: a value does not fit uint32"),
        ({"id": [2**32, 2, 3]}, ValueError, "column id: a value does not fit uint32"),
        ({"name": ["a"]}, ValueError, "differ in length"),
        ({"extra": [1, 2, 3]}, ValueError, r"unknown \['extra'\]"),
    ],
)
def test_wrong_columns_are_refused(changes, error, words):
    with pytest.raises(error, match=words):
        build_table(small(**changes), SMALL)


def test_a_missing_column_is_refused():
    columns = small()
    del columns["px"]
    with pytest.raises(ValueError, match=r"missing \['px'\]"):
        build_table(columns, SMALL)


def test_building_writing_and_reading_parts_does_not_import_pandas():
    code = (
        "import sys; sys.path[:0] = sys.argv[1:]\n"
        "from run_samples import sample_table\n"
        "import pyarrow.parquet as pq, tempfile, pathlib\n"
        "for name in ('images', 'cameras', 'models'):\n"
        "    path = pathlib.Path(tempfile.mkdtemp()) / 'x.parquet'\n"
        "    pq.write_table(sample_table(name, 2), path)\n"
        "    pq.ParquetFile(path).read().to_pylist()\n"
        "print('pandas' in sys.modules)\n"
    )
    paths = [path for path in sys.path if path.endswith("tests")]
    done = subprocess.run([sys.executable, "-c", code, *paths], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


@pytest.mark.parametrize("num", [0, 1, 7, 8, 9, 20])
def test_columns_of_few_rows_are_those_that_are_made_one_by_one(num, monkeypatch):
    rng = np.random.default_rng(num)
    odd = rng.normal(size=num)
    odd[::3], odd[1::4] = np.nan, -np.inf
    columns = {
        "plain": rng.normal(size=num),
        "odd": odd,
        "listed": [None if k % 2 else float(k) for k in range(num)],
        "scalars": list(odd),
        "masked": np.ma.masked_array(odd, rng.random(num) < 0.5),
        "strided": np.repeat(odd, 2)[::2],
        "counted": rng.integers(0, 9, num),
        "whole": [1, *[None] * (num - 1)][:num],
    }
    wanted = pa.schema([(name, pa.int64() if name == "counted" else pa.float64()) for name in columns])
    found = arrow.build_table(columns, wanted)
    found.validate(full=True)
    monkeypatch.setattr(arrow, "_FEW_ROWS", -1)
    expected = arrow.build_table(columns, wanted)
    assert found.equals(expected)
    assert [column.null_count for column in found.columns] == [column.null_count for column in expected.columns]
    assert pickle.loads(pickle.dumps(found)).equals(expected)  # noqa: S301 - as worker processes send them


def test_a_schema_that_lies_where_another_one_did_is_not_taken_for_it():
    for k in range(200):
        wanted = pa.schema([(f"column{k}", pa.int64() if k % 2 else pa.float64())])
        assert arrow.build_table({f"column{k}": [1]}, wanted).schema.equals(wanted)
        del wanted
    assert len(arrow._known_kinds) <= arrow._MANY_SCHEMAS
