"""Laws of simulated scenes: whatever is asked for, sizes are met, tracks whole, noise scales, files are faithful."""

from __future__ import annotations

import dataclasses
import tempfile
from pathlib import Path

import numpy as np
import pycolmap
from hypothesis import given, settings
from hypothesis import strategies as st

from sfm_audit.audit.simulate.adjust import residuals_px, sparse_model, true_claim
from sfm_audit.audit.simulate.colmap_files import write_colmap_binary
from sfm_audit.audit.simulate.defects import DefectKind, DefectSpec
from sfm_audit.audit.simulate.noise import NoiseKind, NoiseSpec, draw_noise
from sfm_audit.audit.simulate.scene import SceneSpec, simulate_scene

SIZED = [kind for kind in DefectKind if kind is not DefectKind.FEW_POINTS]
seeds = st.integers(0, 2**32 - 1)


@st.composite
def specs(draw):
    num_images = draw(st.integers(6, 16))
    kinds = draw(st.lists(st.sampled_from(SIZED), max_size=4))
    images = draw(st.permutations(range(num_images)))[: len(kinds)]
    sizes = draw(st.lists(st.floats(0.05, 5.0), min_size=len(kinds), max_size=len(kinds)))
    return SceneSpec(
        num_images=num_images,
        points_per_image=draw(st.integers(60, 150)),
        width=draw(st.sampled_from([1600, 1200])),
        camera_model=draw(st.sampled_from(["SIMPLE_RADIAL", "SIMPLE_PINHOLE", "SIMPLE_RADIAL_FISHEYE"])),
        shared_camera=draw(st.booleans()),
        noise=NoiseSpec(draw(st.sampled_from(list(NoiseKind))), draw(st.floats(0.0, 1.0))),
        defects=tuple(DefectSpec(*defect) for defect in zip(images, kinds, sizes, strict=True)),
        min_track_length=draw(st.integers(2, 4)),
        max_track_length=draw(st.integers(4, 15)),
    )


@settings(max_examples=20, deadline=None)
@given(spec=specs(), seed=seeds)
def test_every_scene_is_whole(spec, seed):
    scene = simulate_scene(spec, np.random.default_rng(seed))
    lengths = np.bincount(scene.point_idx, minlength=len(scene.xyz_world))
    assert lengths.min() >= spec.min_track_length
    assert lengths.max() <= spec.max_track_length
    assert (np.repeat(np.arange(spec.num_images), np.diff(scene.offsets)) == scene.image_idx).all()
    assert len(np.unique(np.column_stack([scene.image_idx, scene.point_idx]), axis=0)) == len(scene.point_idx)
    assert ((scene.xy_true_px >= 0) & (scene.xy_true_px <= (spec.width, spec.height))).all()
    for planted in scene.defects:
        (asked,) = (d for d in spec.defects if d.image_idx == planted.image_idx)
        assert abs(planted.systematic_px / asked.size_px - 1) < 0.02
    sound = scene.sound[scene.image_idx]
    noise = scene.xy_px - scene.xy_true_px
    np.testing.assert_allclose(residuals_px(scene, true_claim(scene))[sound], noise[sound], atol=1e-8)


@given(kind=st.sampled_from(list(NoiseKind)), gain=st.sampled_from([0.25, 2.0, 8.0]), seed=seeds)
def test_noise_scales_with_its_unit(kind, gain, seed):
    tracks = np.arange(60) // 4
    spec = NoiseSpec(kind, 0.5)
    scaled = dataclasses.replace(spec, sigma_px=0.5 * gain, truncation_px=4.0 * gain)
    one, other = (draw_noise(s, tracks, np.random.default_rng(seed)) for s in (spec, scaled))
    np.testing.assert_allclose(other.xy_px, gain * one.xy_px, rtol=1e-9)
    np.testing.assert_allclose(other.sigma_px, gain * one.sigma_px, rtol=1e-12)


@settings(max_examples=15, deadline=None)
@given(data=st.data(), seed=seeds)
def test_files_keep_any_ids_names_and_order(data, seed):
    scene = simulate_scene(SceneSpec(num_images=6, points_per_image=30), np.random.default_rng(seed))
    model = sparse_model(scene, true_claim(scene))
    rng = np.random.default_rng(seed)
    name = data.draw(st.text(st.characters(codec="utf-8", exclude_characters="\0"), min_size=1, max_size=40))
    point_ids = np.sort(rng.choice(2**40, len(model.points), replace=False)).astype(np.uint64)
    extra = rng.integers(0, 20, 6)
    spread = [np.sort(rng.choice(n + e, n, replace=False)) for n, e in zip(np.diff(scene.offsets), extra, strict=True)]
    model = dataclasses.replace(
        model,
        points=dataclasses.replace(model.points, point3d_id=point_ids),
        images=dataclasses.replace(
            model.images,
            image_id=np.sort(rng.choice(2**20, 6, replace=False)).astype(np.uint32),
            name=tuple(f"{name}{i}" for i in range(6)),
            num_points2d=np.diff(scene.offsets) + extra,
        ),
        observations=dataclasses.replace(model.observations, point2d_idx=np.concatenate(spread)),
    )
    with tempfile.TemporaryDirectory() as folder:
        write_colmap_binary(model, Path(folder), rng)
        read = pycolmap.Reconstruction(folder)
    for i, image_id in enumerate(model.images.image_id.tolist()):
        image, rows = read.images[image_id], slice(scene.offsets[i], scene.offsets[i + 1])
        assert image.name == f"{name}{i}"
        keypoints = [image.points2D[j] for j in spread[i]]
        assert [k.point3D_id for k in keypoints] == point_ids[scene.point_idx[rows]].tolist()
        assert (np.array([k.xy for k in keypoints]) == scene.xy_px[rows]).all()
        assert image.num_points3D == len(spread[i])
    assert sorted(read.points3D) == point_ids.tolist()
