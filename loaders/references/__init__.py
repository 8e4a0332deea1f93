"""Where else the images of a model were measured: poses of references, and position priors.

`poses` says what a list of poses is, `formats` which format a file has, `matching` which image of a model is meant.
"""
