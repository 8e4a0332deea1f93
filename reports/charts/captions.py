"""What does each figure show? One line each, for captions and for those who do not see the figure."""

from __future__ import annotations

from typing import Final

CAPTIONS: Final[dict[str, str]] = {
    "residual_vectors": "Residuals, observed minus projected, magnified. Without a pattern: noise.",
    "residual_field": "Mean residual over the sensor. Orange: longer than noise leaves in one cell of a hundred.",
    "camera_field": "Residual field of the camera: means over all its images, magnified. A lens that its model can say "
    "leaves nothing but noise here; orange: longer than noise leaves in one cell of a hundred.",
    "correlations": "Correlations of its own parameters in the joint system. Near 1 or -1, one stands in for another.",
    "radial_profile": "Radial profile. Off zero along the radius: the lens bends otherwise than its model.",
    "standardised_histogram": "Standardised residuals against N(0, 1).",
    "qq_plot": "Q-Q plot: on the line where the noise is what the noise model says.",
    "scale_comparison": "The same residuals under the robust and under the plain scale, which hides the tails.",
    "misfit_groups": "What is systematic, by kind of misfit, on the model as it stands.",
    "inliers_on_photo": "The inliers on the photo, coloured by their residuals.",
    "expected_error": "Expected error of one measurement with this camera, given the points: a lower bound.",
    "explained_field": "What the named misfit explains of the residuals, magnified.",
}
"""What each figure of `reports.figures` shows, in one line."""
