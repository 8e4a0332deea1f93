"""The prose of docs/paper.md, with places for numbers."""

from __future__ import annotations

from typing import Final

INTRO: Final = """\
# The paper's experiments, done again

Made by `scripts/reproduce_paper.py`; do not edit. Seed {seed}: the same seed gives the same page on one process or
more. The paper: Brissman, Forssén, Edstedt, "Camera Calibration without Camera Access: A Robust Validation Technique
for Extended PnP Methods" (SCIA 2023). Its equations and its numbers: [method.md](method.md)."""

SUMMARY: Final = """\
## In ten lines

1. {counts}.
2. KS of the signed residuals, consistent robust scale, rejects the wrong D(1,0) in {ks_robust} of the sets (low / mid /
   high third of coverage), with the maximum-likelihood scale in {ks_plain} ({said_1}).
3. KS of their lengths, maximum-likelihood scale: {lengths}, and the right D(3,0) in {lengths_right} ({said_1c}).
4. `verdict_misfit` rejects D(1,0) in {misfit} and D(3,0) in {misfit_right}. {best}.
5. D'Agostino-Pearson rejects D(3,0) in {dap_right}, Shapiro-Wilk finds D(1,0) in {sw} ({said_3}).
6. Predicted / empirical sd: {sd}. Of the rejected D(1,0), below 1 px: {low_sd} ({said_5}).
7. The motivating example beyond 3 sd under the robust scale: {tails}; KS: {scales} ({said_8}).
8. Olsson's rule accepts {olsson_wrong} of the wrong and {olsson_right} of the right cameras ({said_9}).
9. MegaDepth's layout, KS under one scale per image: {megadepth}; allowing for noise that differs between tracks,
   {cause} ({said_10}).
10. Zhang's models on stand-ins, KS: {zhang} ({said_7})."""

CLAIMS: Final = """\
## The ten claims

The word follows from the numbers by the rule beside it (`scripts/paper/claims.py`); nobody chose it. A claim that can
be read in two ways has a letter. Third: of the sets by coverage, low / mid / high. Boards: {boards}."""

MOTIVATING: Final = """\
## The motivating example

y = x is true, y = x + 0.5 x^5 is claimed, x uniform in -1..1, Gaussian noise, nothing fitted but the scale. The bulk of
the residuals lies where x^5 is small and is pure noise, the rest is in the tails. A robust scale keeps to the bulk: the
tails stand out. But Kolmogorov's D has its weight in the middle, where a scale that is too large is wrong as well: the
plain scale is rejected {comparison}. (`motivating.motivating_trials`; tail: share of |z| > 3.)

![Data, and quantiles of the standardised residuals](figures/paper_motivating.svg)"""

BOARDS: Final = """\
## Figure 3: the board that comes closer

15 x 15 saddle points, f = 800 px, theta = (-0.0684, 0.0100, 0.0006), 1600 x 1600 px, rotations of +-15 degrees, 56 sets
from far to near, {seeds} seeds. Lidar noise 0.03 px horizontally at the image's centre, a tenth of it vertically.
*rendered*: photographs whose corners a sub-pixel detector found (its error, measured: {detector} px per axis);
*points*: exact corners with 0.03 px of Gaussian noise. D(1,0) and D(3,0) are estimated from each set by EAPRD and
validated, both with the defaults (`board_study.board_rows`; `audit.calibrate.validation.validate`).

The paper does not say with which weights its scale is fitted, and of which residuals its KS is. *robust*: method.md
section 2, consistent at the normal; *plain*: maximum likelihood; *literal*: started from the weights that the paper
names; *median without factor*: a robust scale that is not consistent at the normal, to see what that would do. *ks*,
*dap*, *sw*, *ks_fitted*: of the signed residuals, x and y pooled; *ks_norm*, *ks_norm_unscaled*: of the lengths |z|.

![p-values of all statistics over the sets](figures/paper_figure3.svg)

Dots: median over seeds, band: 80 % of the seeds, dotted: 5 %, figures: share of the sets of a third rejected at 5 %."""

DEVIATIONS: Final = """\
![Standard deviations, and the effect of the missing radial terms](figures/paper_sd.svg)

Left: dots empirical, lines predicted; right: effects that cleaning of noise leaves at 0 are not drawn.

Predicted / empirical standard deviation, median by third (`claims.predicted_ratios`); empirical sd in px, median:"""

GROUPS: Final = """\
Misfit groups that ran: D(1,0): {wrong}. D(3,0): {right}. Under D(3,0) the radial group is null by construction: k2 and
k3 are estimated, and nothing of it is left. On a plane, small in the image, the principal point is nearly a rotation.
`verdict_misfit`: a group is significant at 5 % after Holm and its effect exceeds half of the robust sigma."""

PROTECTION: Final = """\
### Scanned points have errors of their own

The fields of the misfit test are functions of the predicted point, and that contains the error of the scanned point, as
the residual does. On a plane the pose explains some fields exactly; at scanned points it leaves of them just these
errors, which explain the residuals perfectly. `audit.calibrate.lens_misfit` minds that; the test of images in a
reconstruction does not. Share of images with a significant group (Holm, 5 %, of any size), corners: points
(`board_study.protection_rows`):"""

TABLES: Final = """\
## Tables 1 to 3, on stand-ins

The paper's two cameras are not public. *plain* and *wide* (`audit/simulate/room.py`) distort like its axisp3364 and its
axis223m; both have fx != fy and a centre off the middle, so of all models only M5 is right. Wrong by construction are
therefore D(1,0), D(3,0) and PnPRF's division model too.

Table 1: boards of 6 x 6 corners, {train} views to calibrate (OpenCV), {held} held out (`tables.zhang_rows`); medians
over {runs} runs, px; the paper's sd beside it; KS, DAP, SW: share of runs whose held-out residuals it rejects."""

ROOMS: Final = """\
Tables 2 and 3: {rooms} images of 24 annotated points each (`tables.room_rows`); medians, px, and the share of images
that each test rejects at 5 %, of those solved. PnPRF's k belong to its division model, not to D(3,0). Few: with fewer
than 20 inliers (5 px) no verdict is given. Refused: by the estimator."""

MEGADEPTH: Final = """\
## The MegaDepth experiment

A tree in MegaDepth's layout with {images} images of internet photos in {models} models, SIMPLE_RADIAL, one camera per
image, audited with the defaults (`megadepth.megadepth_images`). KS: of the images that it can test. *constant*: one
scale per image, as in the paper; *whitened*: after undoing what the 3D points took; *track*: noise predicted from the
rest of the track. Not the paper's scenes: those are many and large, these are small."""

MEGADEPTH_WORDS: Final = """\
Of {rejected} images rejected under constant noise {stay} are still rejected when noise may differ between tracks:
{gone} of the rejections vanish with the supposition that all noise of an image is alike. Misfit rejects {misfit} of the
{images} images, {both} of those that KS rejects and {others} of those that it accepts: the two answer different
questions. {clean} of the {rejected} are rejected by none of KS under track noise, misfit and pose. scale_ratio (below
1: over-fitted) has the median {ratio}; {below} of the images are below 1.

![Densities of standardised residuals](figures/paper_megadepth.svg)

Two images, each the one in the middle (by D) of those that KS accepts and rejects under constant noise:"""

NO_CORPUS: Final = """\
## The MegaDepth experiment

Not run: no corpus (SFM_AUDIT_CORPUS, or ../shared/corpus)."""

OLSSON: Final = """\
## Olsson's rule beside it

Correct if the mean reprojection distance lies between its first and third quartile. Share accepted; `verdict_misfit`
beside it (share not rejected):"""

CHECKS: Final = """\
## What must hold

`--quick` fails where one of these leaves its band by more than chance explains (1 in 1000, binomial)."""

LIMITS: Final = """\
## What this does not show

- The paper's images, scans and corner detector are not public; board size and lidar noise are not in it. Ours are in
  method.md section 9, and a claim about them is a claim about these.
- "Its" KS, robust scale and weights are readings. Where a reading decides the word, all readings are in the table.
- The stand-ins' lenses are ours: what Table 1 says of M1 and M3 is arithmetic about them, not about Axis cameras.
- 50 images of small scenes are no sample of MegaDepth."""
