"""Could this be a camera, and how well does the image know it? (method.md section 6)."""
