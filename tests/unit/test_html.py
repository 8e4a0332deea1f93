import base64
import hashlib
import io
import itertools
import json
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from report_samples import NASTY_NAMES, read_sample
from run_samples import STATE, make_ref, sample_tables, settings

from sfm_audit.audit.table.diagnoses import Diagnosis, DiagnosisCode
from sfm_audit.audit.table.words import strongest
from sfm_audit.loaders.model import Finding, FindingCode
from sfm_audit.reports import html
from sfm_audit.reports.charts import Residuals
from sfm_audit.reports.charts.sensor import residual_vectors
from sfm_audit.reports.html.photos import find_photo, photo_urls
from sfm_audit.reports.run_folder.reader import RunReader
from sfm_audit.reports.run_folder.store import RunStore
from sfm_audit.reports.text.wording import plain


@pytest.fixture(autouse=True)
def no_flush(monkeypatch):
    monkeypatch.setattr("os.fsync", lambda _: None)


class Page(HTMLParser):
    """Elements and texts of a page, and the content of its scripts."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements, self.texts, self.scripts, self._open = [], [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        if tag in {"script", "style"}:
            self._open.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        if self._open and self._open[-1][0] == tag:
            self._open.pop()

    def handle_data(self, data):
        if not self._open:
            self.texts.append(data)
        elif self._open[-1][0] == "script":
            self.scripts.append((self._open[-1][1], data))

    def ids(self):
        return [attrs["id"] for _, attrs in self.elements if "id" in attrs]

    @property
    def payload(self):
        return next(json.loads(text) for attrs, text in self.scripts if attrs.get("id") == "payload")


def opened(url: str) -> Image.Image:
    return Image.open(io.BytesIO(base64.b64decode(url.removeprefix("data:image/jpeg;base64,"))))


def drawn(n: int) -> list[html.ImagePictures]:
    rng = np.random.default_rng(0)
    residuals = Residuals.build(rng.uniform(0, 400, (80, 2)), rng.normal(0, 1, (80, 2)))
    picture = html.Picture("Residuals.", svg=residual_vectors(residuals))
    return [html.ImagePictures([picture] if i == 0 else []) for i in range(n)]


@pytest.fixture(scope="module")
def nasty(tmp_path_factory):
    run = read_sample(tmp_path_factory.mktemp("run") / "RUN", 30, names=NASTY_NAMES)
    content = html.read_content(run)
    return content, html.render_page(html.PageInput(content, drawn(30)))


def test_names_are_text_and_never_elements(nasty):
    _, text = nasty
    page = Page(text)
    assert [attrs.get("id") for tag, attrs in page.elements if tag == "script"] == ["payload", *[None] * 4]
    assert not [attrs for tag, attrs in page.elements if tag == "img"]
    assert not [name for _, attrs in page.elements for name in attrs if name.startswith("on")]
    names = {row[0] for row in page.payload["rows"]}
    assert {plain(name) for name in NASTY_NAMES} <= names
    shown = {line.strip() for line in page.texts}
    assert {plain(name) for name in NASTY_NAMES if name} <= shown  # the worst images' headings
    assert "49.jpg" not in text


def test_the_page_asks_for_nothing_outside_itself(nasty):
    _, text = nasty
    page = Page(text)
    for _, attrs in page.elements:
        for name in ("src", "href", "action", "srcset", "poster", "data"):
            assert attrs.get(name) is None or attrs[name].startswith(("#", "data:"))
        assert "url(http" not in (attrs.get("style") or "")
    policy = next(
        attrs["content"] for _, attrs in page.elements if attrs.get("http-equiv") == "Content-Security-Policy"
    )
    assert policy.startswith("default-src 'none'")
    assert "@import" not in text.split("</style>")[0]


def test_semantics(nasty):
    _, text = nasty
    page = Page(text)
    tags = [tag for tag, _ in page.elements]
    assert ("html", {"lang": "en"}) in page.elements
    assert tags.count("main") == tags.count("h1") == 1
    assert tags.count("table") == tags.count("caption")
    assert all(
        attrs.get("aria-label") or attrs.get("aria-hidden") == "true" for tag, attrs in page.elements if tag == "svg"
    )
    headings = [int(tag[1]) for tag in tags if re.fullmatch(r"h[1-6]", tag)]
    assert all(b - a <= 1 for a, b in itertools.pairwise(headings))
    ids = page.ids()
    assert len(ids) == len(set(ids))
    links = [attrs["href"] for tag, attrs in page.elements if tag == "a" and attrs["href"] != "#"]
    assert {link.removeprefix("#") for link in links} <= set(ids)


def test_counts_are_the_tables(nasty):
    content, text = nasty
    for policy, members in html.content.POLICIES.items():
        assert sum(content.counts[f"policy {policy}"].values()) == 30
        assert content.counts[f"policy {policy}"]["rejected"] >= max(content.counts[m]["rejected"] for m in members)
    assert content.reasons["misfit_radial"].images == content.verdicts.count("rejected")
    assert "What a verdict does not prove" in text
    assert "cannot see symmetric mis-registration" in " ".join(text.split())
    assert "data/&lt;b&gt;broken" in text


@pytest.mark.parametrize(
    ("verdicts", "expected"),
    [
        (("accepted", "accepted"), "accepted"),
        (("undetermined", "accepted"), "undetermined"),
        (("undetermined", "rejected"), "rejected"),
        ((None, "accepted"), "accepted"),  # not asked
        ((None, None), "undetermined"),
        (("nonsense", "accepted"), "undetermined"),
    ],
)
def test_a_policy_is_as_strict_as_its_strictest_member(verdicts, expected):
    assert strongest(verdicts) == expected


def test_more_rows_than_the_page_holds_are_the_worst_and_it_says_so(tmp_path):
    run = read_sample(tmp_path / "RUN", 60)
    whole, part = html.read_content(run), html.read_content(run, max_rows=20)
    assert [row["image_name"] for row in part.rows] == [row["image_name"] for row in whole.rows[:20]]
    verdicts = [row["verdict"] for row in whole.rows]
    assert verdicts == sorted(verdicts, key=["rejected", "undetermined", "accepted"].index)
    misfit = [row["misfit_px"] for row in whole.rows if row["verdict"] == "rejected"]
    assert misfit == sorted(misfit, reverse=True)
    text = html.render_page(html.PageInput(part))
    assert "The 20 worst of 60 images" in text
    assert "The other 40 are in" in text
    assert part.counts == whole.counts
    assert len(part.numbers["ks_p"]) == 60


def test_a_run_without_images(tmp_path):
    text = html.render_page(html.PageInput(html.read_content(read_sample(tmp_path / "RUN", 0))))
    assert "0 images in 1 model" in text
    assert Page(text).payload["rows"] == []


def test_numbers_that_were_not_computed_are_no_numbers(tmp_path):
    columns = ("misfit_px", "rms_px", "sigma_predicted_px", "ks_p", "ks_stat", "kurtosis_excess", "scale_ratio")
    run = read_sample(tmp_path / "RUN", 5, **{name: np.full(5, np.nan) for name in columns})
    text = html.render_page(html.PageInput(html.read_content(run)))
    payload = Page(text).payload
    at = [fact["name"] for fact in payload["facts"]].index("rms_px") + payload["firstFact"]
    assert all(row[at] is None for row in payload["rows"])


@pytest.mark.parametrize("name", ["../secret.jpg", "/etc/passwd", "a/../../secret.jpg", "x" * 300, "a\0b", ""])
def test_photos_are_never_looked_for_outside_their_folder(tmp_path, name):
    (tmp_path / "photos").mkdir()
    (tmp_path / "secret.jpg").write_bytes(b"secret")
    assert find_photo(tmp_path / "photos", {"image_name": name, "scene": "s"}) is None
    assert find_photo(tmp_path / "photos", {"image_name": "secret.jpg", "scene": ".."}) is None


def test_photos_are_not_read_through_links_that_lead_out_of_their_folder(tmp_path):
    (tmp_path / "photos").mkdir()
    (tmp_path / "secret.jpg").write_bytes(b"secret")
    (tmp_path / "photos" / "b.jpg").write_bytes(b"photo")
    (tmp_path / "photos" / "out.jpg").symlink_to(tmp_path / "secret.jpg")
    (tmp_path / "photos" / "in.jpg").symlink_to("b.jpg")
    assert find_photo(tmp_path / "photos", {"image_name": "out.jpg", "scene": "s"}) is None
    assert find_photo(tmp_path / "photos", {"image_name": "in.jpg", "scene": "s"}) is not None


def test_photos_are_found_by_name_or_in_their_scene_and_read_small(tmp_path):
    (tmp_path / "s" / "images").mkdir(parents=True)
    path = tmp_path / "s" / "images" / "a.jpg"
    Image.new("RGB", (3000, 1500), (10, 20, 30)).save(path)
    assert find_photo(tmp_path, {"image_name": "a.jpg", "scene": "s"}) == path
    assert find_photo(tmp_path / "s" / "images", {"image_name": "a.jpg", "scene": "s"}) == path
    large, small = photo_urls(path, 900, 112)
    assert [opened(url).size for url in (large, small)] == [(900, 450), (112, 56)]
    path.write_bytes(b"no photo")
    assert photo_urls(path, 900) is None


def test_the_table_library_is_the_published_one():
    folder = Path(html.__file__).parent / "vendor"
    content = (folder / "dataTables.min.js").read_bytes()
    assert content.startswith(b"/*! DataTables 3.1.5\n")
    assert hashlib.sha256(content).hexdigest() == "38017a5586acd9c6eb6bbfe8b6938e1a25bdc717c5acfcb07e0c9d663282c59d"
    assert b"</script" not in content
    assert "MIT License" in (folder / "dataTables-License.txt").read_text(encoding="utf-8")


def test_the_snippets_of_the_docs_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = (Path(__file__).resolve().parents[2] / "docs" / "report.md").read_text(encoding="utf-8")
    own_table = re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)[1]
    exec(own_table, {})  # noqa: S102 - our own page
    assert Path("scales.png").read_bytes().startswith(b"\x89PNG")


def test_what_stands_between_backticks_is_code():
    template = html.page.environment().from_string("{{ text | coded }}")
    assert template.render(text="run `a <b>`, not `c`") == "run <code>a &lt;b&gt;</code>, not <code>c</code>"
    assert template.render(text="5` <i>") == "5` &lt;i&gt;"


def test_the_page_says_what_to_do_and_explains_its_codes(tmp_path):
    what = ("lenses lack a term", "refit them", "sfm-audit diagnose RUN data/<i>a")
    diagnosis = Diagnosis(DiagnosisCode.OWN_LENSES, None, "medium", 2, ("<b>.jpg",), *what)
    finding = Finding(FindingCode.TRACKS_DISAGREE, 3, "3 tracks name other images")
    ref = make_ref("data/a")
    models = {"findings": [[finding]], "diagnoses": [[diagnosis]]}
    reasons = [["misfit_radial: 0.42 px"], ["a_code_of_later: 7"]]
    with RunStore(tmp_path / "run", settings()) as store:
        store.write(ref, STATE, sample_tables(ref, models=models, reasons=reasons), 0.1)
        store.finish(None, [], 1.0)
    run = RunReader.open(tmp_path / "run")
    page = Page(html.render_page(html.PageInput(html.read_content(run))))
    said = " ".join("".join(page.texts).split())
    assert f"sfm-audit diagnose {run.folder} data/<i>a" in said
    assert said.count("3 tracks name other images") == 1
    told = html.PageInput(html.read_content(run), pictures=[html.ImagePictures((), None)])
    assert html.render_page(told).count("3 tracks name other images") == 2  # at the image that it concerns, too
    for words in ("lenses lack a term", "Do: refit them", "2 images, medium, such as <b>.jpg"):
        assert words in said
    assert {"code-reason-misfit_radial", "code-finding-tracks_disagree"} <= set(page.ids())
    assert "code-reason-a_code_of_later" not in page.ids()
    links = {attrs.get("href", "") for tag, attrs in page.elements if tag == "a"}
    wanted = {link for link in links if link.startswith("#code-")}
    assert wanted == {"#code-reason-misfit_radial", "#code-finding-tracks_disagree"}


def test_witnesses_link_the_images_they_speak_against(tmp_path):
    said = ["priors_disagree: 40 m"]
    run = read_sample(
        tmp_path / "RUN",
        20,
        names=NASTY_NAMES[:3],
        verdict=["undetermined"] * 15 + ["accepted"] * 5,
        reasons=[said] * 15 + [[]] * 5,
        witnesses=[["pairs", "priors"]] * 18 + [["pairs"], None],
    )
    content = html.read_content(run)
    page = Page(html.render_page(html.PageInput(content)))
    linked = [int(attrs["data-row"]) for tag, attrs in page.elements if tag == "a" and attrs.get("class") == "open"]
    assert len(linked) == len(set(linked)) == 12
    assert all(content.rows[i]["reasons"] == said for i in linked)
    shown = " ".join(" ".join(page.texts).split())
    assert "pairs 19 none -" in shown
    assert "priors 18 15 :" in shown
    assert "and 3 more" in shown
    assert "Witnesses" not in "".join(
        Page(html.render_page(html.PageInput(html.read_content(read_sample(tmp_path / "B", 2))))).texts
    )


def test_a_model_s_findings_stand_beside_the_witness_that_made_them():
    model = {"dataset": "d", "scene": "s", "component": "0", "model_path": "m", "num_images": 5, "witnesses": ["pairs"]}
    findings = [{"code": "priors_scale", "text": "13 m"}, {"code": "short_tracks", "text": "2 points"}]
    told = html.witnesses_of(html.Statements(), [{**model, "findings": findings}], [])
    assert [(line["name"], line["findings"]) for line in told["models"][0]["witnesses"]] == [
        ("pairs", []),
        ("priors", [("priors_scale", "13 m")]),
    ]
    assert html.witnesses_of(html.Statements(), [{**model, "witnesses": None, "findings": []}], [])["models"] == []


@pytest.mark.parametrize(("sds", "there"), [((None, np.nan), False), ((0.001, None), True)])
def test_columns_that_only_some_runs_have_are_shown_where_they_hold_something(tmp_path, sds, there):
    run = read_sample(tmp_path / "RUN", 2, sd_rotation_deg=[None, None], sd_centre=list(sds))
    page = Page(html.render_page(html.PageInput(html.read_content(run))))
    columns = {column["name"]: column["rank"] for column in page.payload["columns"]}
    assert ("sd_centre" in columns) == ("sd_centre" in [fact["name"] for fact in page.payload["facts"]]) == there
    assert columns["ks_p"] == (3 if there else 2)
    assert not {"sd_rotation_deg", "prior_distance", "reference_centre_rel"} & columns.keys()
