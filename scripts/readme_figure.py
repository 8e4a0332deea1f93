"""The picture of README.md, docs/figures/readme.svg: residuals of a sound image and of one with a wrong lens.

Simulated photos (the demo's, seed 0), as everything that can be published without asking a photographer. --quick draws
into a temporary folder and fails where the pictures would not show what their titles say.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path
from typing import Any, Final

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

from sfm_audit.audit.cli.main import main as sfm_audit

ROOT: Final = Path(__file__).resolve().parent.parent
TARGET: Final = ROOT / "docs" / "figures" / "readme.svg"
SOUND: Final = "IMG_0024.jpg"
WRONG: Final = "IMG_0010.jpg"  # its lens was given a k2 that the camera does not have
CELLS: Final = (9, 7)
MIN_PER_CELL: Final = 3
MAGNIFIED: Final = 180.0
STYLE: Final[dict[Any, Any]] = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans", "Helvetica", "Arial"],
    "font.size": 8.5,
    "axes.linewidth": 0.6,
    "figure.facecolor": "white",
    "svg.fonttype": "none",
    "svg.hashsalt": "readme",
}


def audited(folder: Path) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Simulate and audit the demo's photos; return its images, and its observations."""
    for command in (
        ["demo", "-o", str(folder / "demo"), "--quiet"],
        ["run", str(folder / "demo/photos"), "-o", str(folder / "RUN"), "--observations", "--quiet"],
    ):
        if sfm_audit(command) != 0:
            sys.exit("readme_figure: the demo could not be audited")
    return pd.read_parquet(folder / "RUN/images").set_index("image_name"), pd.read_parquet(folder / "RUN/observations")


def field(observations: pd.DataFrame, image: pd.Series[Any]) -> pd.DataFrame:
    """Return mean residual (px) and centre (px) of each cell of an image, with its number of inliers."""
    rows = observations[observations["image_name"] == image.name].copy()
    for axis, extent, num in (("x", image["width"], CELLS[0]), ("y", image["height"], CELLS[1])):
        rows[f"cell_{axis}"] = np.minimum((rows[f"{axis}_px"] * num / extent).astype(int), num - 1)
    cells = rows.groupby(["cell_x", "cell_y"]).agg(
        x=("x_px", "mean"),
        y=("y_px", "mean"),
        u=("residual_x_px", "mean"),
        v=("residual_y_px", "mean"),
        n=("x_px", "size"),
    )
    return cells[cells["n"] >= MIN_PER_CELL]


def draw(images: pd.DataFrame, observations: pd.DataFrame, target: Path) -> None:
    """Draw both images beside each other."""
    with mpl.rc_context(STYLE):
        figure, axes = plt.subplots(1, 2, figsize=(7.4, 3.2), layout="constrained")
        for ax, name, colour in zip(axes, (SOUND, WRONG), ("#0072B2", "#D55E00"), strict=True):
            image: pd.Series[Any] = images.loc[name]  # type: ignore[assignment]
            cells = field(observations, image)
            ax.quiver(
                cells["x"],
                cells["y"],
                MAGNIFIED * cells["u"],
                MAGNIFIED * cells["v"],
                color=colour,
                angles="xy",
                scale_units="xy",
                scale=1,
                width=0.006,
                headwidth=4,
            )
            ax.set(xlim=(0, image["width"]), ylim=(image["height"], 0), aspect="equal", xticks=[], yticks=[])
            ax.set_title(title(image), loc="left")
        figure.savefig(target, metadata={"Date": None})
        plt.close(figure)


def title(image: pd.Series[Any]) -> str:
    """Return two lines: what the mean error says, and what the audit says."""
    said = f"mean error {image['mean_px']:.2f} px, {image['num_inliers']} inliers"
    if pd.isna(image["misfit_group"]):
        return f"{said}\n{image['verdict']}: nothing is left but noise"
    group, size, advice = image["misfit_group"], image["misfit_px"], image["advised_camera_model"]
    return f"{said}\n{image['verdict']}: {group} misfit of {size:.2f} px, use {advice}"


def main() -> int:
    """Draw the picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="draw into a temporary folder")
    args = parser.parse_args()
    mpl.use("Agg")
    with tempfile.TemporaryDirectory() as folder:
        images, observations = audited(Path(folder))
        verdicts = images.loc[[SOUND, WRONG], "verdict"].tolist()
        if verdicts != ["accepted", "rejected"] or images.loc[WRONG, "misfit_group"] != "radial":
            sys.exit(f"readme_figure: {SOUND} and {WRONG} are {verdicts}; choose others")
        draw(images, observations, Path(folder) / "readme.svg" if args.quick else TARGET)
    return 0


if __name__ == "__main__":
    sys.exit(main())
