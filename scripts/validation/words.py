"""The prose of docs/validation.md, with places for numbers."""

from __future__ import annotations

from typing import Final

INTRO: Final = """\
# Validation

Made by `scripts/validate_statistics.py`; do not edit. Seed {seed}: the same seed gives the same page on one process or
more. Every number below is a count over simulated images whose truth is known; no real image is in it.

An audit is believed for its error rates. For every test and every verdict this page measures how often a *correct*
camera is rejected (size: 5 % is wanted of a test at the 5 % level, less of a verdict), how often a *wrong* one is found
(power, by how many pixels it is wrong), whether the blame falls on the right image and the right cause, and whether the
advice helps. The rules in use elsewhere are measured on the same images.

A bound **{holds}** if the measured share lies inside; it is **{violated}** if the share lies so far outside that a true
share on the bound gives such a count less than one time in a thousand (binomial, two-sided); in between the cell is
counted as outside **{chance}**. Images of one scene share points, so their counts vary somewhat more than the binomial
says. A bound of 0 or 100 % leaves nothing to chance."""

FIGURES: Final = """\
## Sizes and powers in two figures

Correct cameras: how often each test of the misfit groups rejects at 5 %, against the number of points (log scale), and
wrong ones: how often they are found, against how wrong they are. The tables behind both, by noise and number of points,
with parameters that were never freed and how well a focal length is known:
[validation_details.md](validation_details.md).

![Size of the misfit groups against n](figures/validation_size.svg)

![Power against the size of the defect](figures/validation_power.svg)"""

DETAILS: Final = """\
# Validation: sizes and powers

Made by `scripts/validate_statistics.py`; do not edit. Seed {seed}. The tables behind
[validation.md](validation.md), which says what is simulated and what holds."""

SETUP: Final = """\
## What is simulated

All images are 1600 x 1200 px, focal length about 1000 px, claimed to be SIMPLE_RADIAL (f, k1; principal point at the
centre, not refined), points up to the corners at depths 4 to 10. Noise has 0.5 px per axis.

*Single images*: n independent 3D points uniform over the image. Pose, f and k1 are fitted by least squares, then the
image is audited as `--points independent` under the `constant` noise model.

*Scenes*: 40 images on a jittered grid, own camera each unless said otherwise, tracks of 3 to 15 images, about n points
per image. Poses, points, f and k1 are bundle-adjusted with pycolmap to convergence, then the model is audited with the
defaults (`track` noise model, policy `standard`, tau = {tau} px). Scenes that did not reach an optimum, because an
image with few points in a corner drifts, were drawn again: {redrawn}.

*Defects* have a random direction and a systematic size: the RMS length in px of what remains of the noise-free
displacement after the image's own pose, f and k1 were refitted to the true points. Of six kinds in turn: k2, k3,
tangential, aspect ratio, principal point, rolling shutter; in scenes uniform in 0.2 to 1.2 px.

| noise | law, standard deviation 0.5 px per axis |
|---|---|
| gaussian | independent normal |
| laplace, student_t5 | independent Laplace; Student's t with 5 degrees of freedom |
| per_track_lognormal | normal, one lognormal scale per track, whose logarithm has sd 0.5 (\\*) |
| per_observation_scale | normal, one lognormal scale per observation, as keypoint scales (sd 0.5) |
| truncated | bivariate t with 2 degrees of freedom, cut at 4 px: what COLMAP's filter leaves of heavy tails |
| wrong_matches | normal, but 2 % of the observations lie anywhere within 4 px of the truth |

(\\*) A single image has no tracks: there the scale belongs to the observation and has sd 0.75, as in the demo."""

SINGLE_MISFIT: Final = """\
## Size: correct cameras, single images

Share of images with p < 5 %, per misfit group, and rejected by the verdict (Holm over the groups, effect above tau). A
dash: fewer than four points per direction of the group, so that it is not tested. Below 100 points the tests of heavy
tails are conservative: one outlier dominates the score and its own variance alike."""

SINGLE_GOODNESS_OF_FIT: Final = """\
Goodness of fit under `constant` on the same images. This noise model supposes equal Gaussian noise: what it rejects
elsewhere is the noise, while the camera is correct. `verdict_plausible` or `verdict_pose` reject {rejected} of these
images and are undetermined in {undetermined}."""

SCENE_GOODNESS_OF_FIT: Final = """\
## Size: correct cameras, bundle-adjusted scenes

Goodness of fit under the `track` noise model (`ks constant`: under `constant`), and verdicts. Plain KS is conservative,
because pose, camera and scale were fitted. The `track` model is meant for noise that belongs to the track; noise that
is drawn per observation from heavy tails it cannot know, and the shape tests say so."""

SCENE_MISFIT: Final = "Misfit groups on the same images, image by image as the model stands (`misfit_<group>_p`)."

SCENE_JOINT: Final = """\
The same in the joint test, where points, poses and the parameters of all cameras are free too, and the verdicts, which
rest on it. Below 100 points it is liberal: nothing corrects the scores for what the many free parameters took out of
them, as the leverages do in the test of a single image. The verdict also asks for Holm, Benjamini-Hochberg and tau."""

SHARED_SIZE: Final = "The same where all images share one camera and are tested singly (250 points)."

SCALES: Final = """\
Scales, px, where the truth is 0.5 (for per-track noise the root mean square over tracks). *raw*: robust sd of the raw
residuals, which their own points have shrunk; *predicted*: by the track model."""

POWER: Final = """\
## Power: wrong cameras, single images

Gaussian noise of 0.5 px. *own group*: p < 5 % in the group that bears the defect's name; *of these right*: the cause
named right among the rejected; ks to sw: rejected at 5 % under `constant`."""

EFFECT: Final = """\
**Is the effect in px the true one?** Ratio of the reported `systematic_px`, in the group that bears the defect's name,
to the true systematic RMS. Noise is what limits it: the estimate of an effect of s px from n points with sigma px noise
per axis has a standard deviation of about sigma / sqrt n px whatever its size, that is {error} px at n = 250, and 20 %
of a small effect is less than that. {word}"""

BLAME: Final = """\
## Whose fault: scenes with wrong cameras among correct ones

Images with a significant effect (q < 5 %) above tau, by true size; seven noise kinds in equal parts. *alone*: each
image tested as the model stands, with the points as they are: shared points carry a wrong image's field into its
neighbours, and hide a part of it. *joint*: what neither points nor poses nor any camera's own parameters could take
up, wrong images freed one after the other (sequential inclusion); `verdict_misfit` rests on that. *150 points*:
instead of 400 per image. *short tracks*: 3 or 4 images."""

CAUSES: Final = """\
Named causes of the images found, a quarter wrong (tangential and principal point count as one answer, and affine as
an answer to rolling shutter):"""

SEVERITY: Final = """\
What the misfits that were found (effect above tau) are worth: by how much rotation, centre (share of the median depth)
and focal length (share) of the image would change if the misfit were admitted (medians), and what follows: the
severity of the rejection, or acceptance with the remark `misfit_without_worth` where that is next to nothing. *effect
/ truth*: of the joint test; points, poses and focal lengths take up a part of what the image's own refit leaves."""

FROZEN: Final = """\
## Parameters that were wrong and never freed

Scenes of 24 images with 400 points, all seven noise kinds, two scenes each. Everything is adjusted, then parameters
are set wrong (f by 8 %, k1 by 0.04, up and down in turn; distortion at least 0.03 in k1), then poses and points are
adjusted with all cameras fixed: what an imported calibration leaves. *guilty*, *others*: images whose camera is, is
not wrong. *camera*, *misfit*, *standard*: rejected by that verdict or policy. *own_step_px*: median of the guilty,
largest of the others. *named*: the parameter that the reason names, per camera. *worst*: of the implied values of all
wrong parameters, in sd; *right*: cameras whose implied values are within 5 sd or 2 % of the truth."""

FOCAL_SD: Final = """\
## How well is a focal length known?

Scenes without defects: root mean square of (f - truth) / sd over images, 1 wanted. *joint*: sd of the joint system,
with points, poses and all cameras free (`sd_focal_px`); *conditional on the points* (`sd_focal_px_conditional`)
pretends that points are known. Adjustment was plain least squares, while the joint system weighs outliers down: hence
more than 1 where tails are heavy."""

POSES: Final = """\
## Poses moved after the adjustment, and images that see a corner only

Per scene of 40 images four poses moved by 1 to 3 px RMS after bundle adjustment, and four images left with 8 to 24
points in one corner. Rejected by each verdict; not plausible and the policies: rejected or undetermined. Last column:
median."""

CAMERAS: Final = """\
## One camera for all images

20 images of 150 points share one camera whose lens has the k2 that its model lacks; 0 is the healthy twin (all seven
noise kinds). Pooled tests: share of scenes with p < 5 % per group, median p and px of radial. Then the share of images
that verdict_misfit rejects, and that are told that the camera as a whole is at fault (`shared_camera`)."""

ADVICE: Final = """\
## Does the advised camera model fit?

Scenes of 20 images with one defective image (300 points per image, 0.2 to 1.2 px), or with one shared camera that
lacks k2 = 0.02 or 0.05 (150 points per image). The camera is switched to the advised model, new parameters 0, refined
with all else by pycolmap, and audited again; it passes if verdict_misfit accepts the image (shared: if no group of the
camera is material); *policy standard*: accepted by all members (shared: all images). *none: ...* is advice that no
model would help. Images that were not rejected get no advice."""

RULES: Final = """\
## Rules in use elsewhere, on the same images

Scenes with a quarter of the images wrong. A threshold *in hindsight* is the one that would have served best on these
very images (largest difference of the two shares), which nobody has in practice; that all scenes have the same noise
level favours it further. Biasedness (the median over cells of the KL divergence of the residuals' histogram from a
normal) was made for calibrations with 1e5 and more residuals; cells with fewer than 5 residuals are left out as in its
program, so on 50 x 50 cells no image of this size has one left; 8 x 8 cells is what an image can fill. Olsson's rule
calls a camera correct if the mean reprojection distance lies between its first and third quartile, which it does for
almost any distribution."""

LIMITS: Final = """\
## What this does not show

- Simulated lenses, layouts and noise. Real noise is more varied than any of the seven laws here, and real wrong cameras
  are wrong in several ways at once.
- The size of a defect is what remains visible to the image's own refit on true points. What all images share and points
  absorb entirely is invisible to any test of residuals.
- Verdicts rest on one model at a time. A wrong reconstruction that is consistent in itself passes, unless a witness
  outside of it was asked and sees that."""
