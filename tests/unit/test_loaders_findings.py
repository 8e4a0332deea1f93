"""Each finding is made by its own defect and by nothing else; the corpus's traps are found."""

from dataclasses import replace
from pathlib import Path

import pytest
from corpus import needs_corpus
from model_writer import UNLINKED, Camera, Image, Model, Point, tiny_model, write_binary, write_text

from sfm_audit.loaders import FindingCode, open_model

NAN, INF = float("nan"), float("inf")
CAMERAS, IMAGES, POINTS = tiny_model().cameras, tiny_model().images, tiny_model().points
FIRST, SECOND, LAST = IMAGES


def with_camera(**changes: object) -> Model:
    return tiny_model().but(cameras=(replace(CAMERAS[0], **changes), CAMERAS[1]))


def with_first(**changes: object) -> Model:
    return tiny_model().but(images=(replace(FIRST, **changes), SECOND, LAST))


def with_points(*points: Point) -> Model:
    return tiny_model().but(points=points)


def moved(x: float, y: float) -> Model:
    return with_first(points2d=((x, y, 12), *FIRST.points2d[1:]))


WITHOUT_THEIR_COUNT = {FindingCode.EMPTY_MODEL, FindingCode.TRACKS_DISAGREE}  # the text has its two parts
PORTRAIT = {"width": 480, "height": 640}
DEFECTS = {
    "no images": (tiny_model().but(cameras=(), images=(), points=()), {FindingCode.EMPTY_MODEL: 2}),
    "orphans": (tiny_model().but(cameras=(*CAMERAS, Camera(8), Camera(9))), {FindingCode.ORPHAN_CAMERAS: 2}),
    "camera missing": (tiny_model().but(cameras=CAMERAS[:1]), {FindingCode.MISSING_CAMERAS: 1}),
    "all cameras missing": (tiny_model().but(cameras=()), {FindingCode.MISSING_CAMERAS: 3}),
    "focal length nan": (with_camera(params=(NAN, 320.0, 240.0)), {FindingCode.NON_FINITE_CAMERAS: 1}),
    "swapped, centre": (with_camera(**PORTRAIT), {FindingCode.IMAGE_SIZE_SWAPPED: 1}),
    "swapped, off-centre": (
        with_camera(**PORTRAIT, params=(500.0, 500.0, 200.0)),
        {FindingCode.IMAGE_SIZE_SWAPPED: 1},
    ),
    "portrait": (with_camera(**PORTRAIT, params=(500.0, 240.0, 320.0)), {}),
    "square": (with_camera(width=640, height=640, params=(500.0, 320.0, 320.0)), {}),
    "far off-centre": (with_camera(params=(500.0, 900.0, 240.0)), {}),
    "no principal point": (with_camera(model_id=17, params=(640.0, 480.0)), {}),
    "two of a name": (tiny_model().but(images=(FIRST, SECOND, replace(LAST, name="a.jpg"))), {"duplicate_names": 2}),
    "pose nan": (with_first(pose=(1, 0, 0, 0, NAN, 0, 0)), {FindingCode.NON_FINITE_POSES: 1}),
    "rotation inf": (with_first(pose=(INF, 0, 0, 0, 1, 0, 0)), {FindingCode.NON_FINITE_POSES: 1}),
    "rotation too long": (with_first(pose=(1.00002, 0, 0, 0, 1, 0, 0)), {FindingCode.NON_UNIT_QUATERNIONS: 1}),
    "rotation zero": (with_first(pose=(0, 0, 0, 0, 1, 0, 0)), {FindingCode.NON_UNIT_QUATERNIONS: 1}),
    "rotation nearly unit": (with_first(pose=(1.000005, 0, 0, 0, 1, 0, 0)), {}),
    "observation nan": (moved(NAN, 5.0), {FindingCode.NON_FINITE_OBSERVATIONS: 1}),
    "observations inf and -inf": (
        with_first(points2d=((INF, 1.0, 12), FIRST.points2d[1], (-INF, 1.0, 5), FIRST.points2d[3])),
        {FindingCode.NON_FINITE_OBSERVATIONS: 2},
    ),
    "left of the image": (moved(-0.001, 5.0), {FindingCode.OBSERVATIONS_OUTSIDE: 1}),
    "right of the image": (moved(640.001, 5.0), {FindingCode.OBSERVATIONS_OUTSIDE: 1}),
    "above the image": (moved(5.0, -1.0), {FindingCode.OBSERVATIONS_OUTSIDE: 1}),
    "below the image": (moved(5.0, 480.001), {FindingCode.OBSERVATIONS_OUTSIDE: 1}),
    "on the corner": (moved(640.0, 480.0), {}),
    "outside and nan": (
        with_first(points2d=((NAN, 1.0, 12), FIRST.points2d[1], (-9.0, 1.0, 5), FIRST.points2d[3])),
        {FindingCode.OBSERVATIONS_OUTSIDE: 1, FindingCode.NON_FINITE_OBSERVATIONS: 1},
    ),
    "point inf": (with_points(replace(POINTS[0], xyz=(INF, 0, 1)), *POINTS[1:]), {FindingCode.NON_FINITE_POINTS: 1}),
    "errors zero": (with_points(*(replace(p, error=0.0) for p in POINTS)), {FindingCode.STORED_ERRORS_ZERO: 3}),
    "one error zero": (with_points(replace(POINTS[0], error=0.0), *POINTS[1:]), {}),
    "errors missing": (with_points(*(replace(p, error=-1.0) for p in POINTS)), {FindingCode.STORED_ERRORS_MISSING: 3}),
    "error nan": (with_points(replace(POINTS[0], error=NAN), *POINTS[1:]), {FindingCode.STORED_ERRORS_MISSING: 1}),
    "dangling": (with_points(*POINTS[1:]), {FindingCode.DANGLING_POINT_IDS: 2}),
    "all dangling": (with_points(), {FindingCode.DANGLING_POINT_IDS: 6, FindingCode.EMPTY_MODEL: 1}),
    "unseen point": (with_points(*POINTS, Point(99)), {FindingCode.UNSEEN_POINTS: 1}),
    "short track": (
        tiny_model().but(
            images=(FIRST, SECOND, replace(LAST, points2d=((1.0, 1.0, 99),))), points=(*POINTS, Point(99, ((90, 0),)))
        ),
        {FindingCode.SHORT_TRACKS: 1},
    ),
    "seen twice": (
        tiny_model().but(
            images=(FIRST, SECOND, replace(LAST, points2d=((1.0, 1.0, 99), (2.0, 2.0, 99), (3.0, 3.0, 99)))),
            points=(*POINTS, Point(99, ((90, 0), (90, 1), (90, 2)))),
        ),
        {FindingCode.REPEATED_OBSERVATIONS: 2},
    ),
    "seen twice, others between": (
        tiny_model().but(
            images=(replace(FIRST, points2d=(*FIRST.points2d, (2.0, 2.0, 12))), SECOND, LAST),
            points=(POINTS[0], replace(POINTS[1], track=(*POINTS[1].track, (3, 4))), POINTS[2]),
        ),
        {FindingCode.REPEATED_OBSERVATIONS: 1},
    ),
    "link without track": (
        with_points(replace(POINTS[0], track=POINTS[0].track[:1]), *POINTS[1:]),
        {FindingCode.TRACKS_DISAGREE: 1},
    ),
    "track without link": (
        with_points(replace(POINTS[0], track=(*POINTS[0].track, (3, 1))), *POINTS[1:]),
        {FindingCode.TRACKS_DISAGREE: 1},
    ),
    "track of another point": (
        with_points(replace(POINTS[0], track=((3, 2), (4, 1))), *POINTS[1:]),
        {FindingCode.TRACKS_DISAGREE: 2},
    ),
    "track into nowhere": (
        with_points(replace(POINTS[0], track=(*POINTS[0].track, (3, 4), (90, 0), (5, 0), (5, 0))), *POINTS[1:]),
        {FindingCode.TRACKS_DISAGREE: 3},
    ),
    "track names an element twice": (with_points(replace(POINTS[0], track=POINTS[0].track * 2), *POINTS[1:]), {}),
    "links without tracks": (
        with_points(*(replace(p, track=()) for p in POINTS)),
        {FindingCode.TRACKS_DISAGREE: 6},
    ),
}


@pytest.mark.parametrize("write", [write_binary, write_text])
@pytest.mark.parametrize("name", DEFECTS)
def test_a_planted_defect_is_found_counted_and_nothing_else_is(tmp_path: Path, name: str, write):
    source, expected = DEFECTS[name]
    findings = open_model(write(tmp_path, source)).findings
    assert {finding.code: finding.count for finding in findings} == expected
    for finding in findings:
        assert str(finding.count) in finding.text or finding.code in WITHOUT_THEIR_COUNT
        assert "\n" not in finding.text


def test_findings_name_an_example(tmp_path: Path):
    source = tiny_model().but(cameras=(*CAMERAS, Camera(41)), points=(*POINTS, Point(77)))
    texts = {finding.code: finding.text for finding in open_model(write_binary(tmp_path, source)).findings}
    assert texts[FindingCode.ORPHAN_CAMERAS] == "1 of 3 cameras belong to no image, e.g. camera 41"
    assert texts[FindingCode.UNSEEN_POINTS] == "no image links to 1 of 4 3D points, e.g. point 77"


def test_a_track_difference_names_both_sides(tmp_path: Path):
    (finding,) = open_model(write_binary(tmp_path, DEFECTS["track of another point"][0])).findings
    assert finding.text == (
        "1 of 6 links are in no track (e.g. image 4 to point 5); "
        "1 of 6 track elements are no image's link (e.g. point 5 in image 4, 2D point 1)"
    )


def test_dangling_links_keep_their_place(tmp_path: Path):
    model = open_model(write_binary(tmp_path, DEFECTS["dangling"][0]))
    assert model.observations.point_idx.tolist() == [0, -1, 1, -1, 0, 1]


def test_unlinked_2d_points_may_lie_anywhere(tmp_path: Path):
    source = tiny_model().but(images=(FIRST, SECOND, Image(90, "z", ((-5.0, NAN, UNLINKED), (INF, 1e9, UNLINKED)))))
    assert open_model(write_binary(tmp_path, source)).findings == ()


TRAPS = {
    "gtsfm_palace_txt": {FindingCode.TRACKS_DISAGREE, FindingCode.IMAGE_SIZE_SWAPPED, FindingCode.OBSERVATIONS_OUTSIDE},
    "gtsfm_lund_cluster_txt": {FindingCode.TRACKS_DISAGREE, FindingCode.STATED_COUNT_DIFFERS},
    "gtsfm_unsorted_txt": {FindingCode.TRACKS_DISAGREE, FindingCode.UNSEEN_POINTS},
    "cedric_0401": {FindingCode.STORED_ERRORS_MISSING},  # every stored error is -1; pycolmap's mean of that is 0
    "gtsfm_astrovision_vesta": {FindingCode.SHORT_TRACKS, FindingCode.STORED_ERRORS_ZERO},
    "yinsy_A": {FindingCode.BINARY_TEXT_DISAGREE},
    "softmurata": {FindingCode.ORPHAN_CAMERAS},
    "yowsitian_dense": {FindingCode.OBSERVATIONS_OUTSIDE},
}
COUNTS = {
    ("gtsfm_palace_txt", FindingCode.TRACKS_DISAGREE): 2 * 989,  # the corpus's manifest: 989 of 1000
    ("gtsfm_lund_cluster_txt", FindingCode.TRACKS_DISAGREE): 2 * 5160,  # 5160 of 5163
    ("softmurata", FindingCode.ORPHAN_CAMERAS): 513,
    ("yowsitian_dense", FindingCode.OBSERVATIONS_OUTSIDE): 3019,
    ("yowsitian_sparse", FindingCode.OBSERVATIONS_OUTSIDE): 99,
}


@needs_corpus
@pytest.mark.corpus
@pytest.mark.parametrize("name", TRAPS)
def test_the_traps_of_the_corpus_are_found(corpus: Path, name: str):
    assert TRAPS[name] <= {finding.code for finding in open_model(corpus / "models" / name).findings}


@needs_corpus
@pytest.mark.corpus
@pytest.mark.parametrize(("name", "code"), COUNTS)
def test_the_traps_are_counted_as_the_manifest_does(corpus: Path, name: str, code: FindingCode):
    counts = {finding.code: finding.count for finding in open_model(corpus / "models" / name).findings}
    assert counts[code] == COUNTS[name, code]


@needs_corpus
@pytest.mark.corpus
@pytest.mark.parametrize("name", ["own_sceaux_castle_opencv", "hsu_fox_bin", "pradyumna_s1", "flaugusto_rigs0"])
def test_healthy_models_have_no_finding_but_repeated_observations(corpus: Path, name: str):
    codes = {finding.code for finding in open_model(corpus / "models" / name).findings}
    assert codes <= {FindingCode.REPEATED_OBSERVATIONS}  # COLMAP itself makes those
