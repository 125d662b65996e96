"""Velocity, gravity and depth at which the fit of a translating camera starts: linear in the points.

In front of a plane across the start's axis, a point moves by F (c₁ − c₂) h ρ beside the rotation: F is its flow per
step over depth, ρ the plane's inverse depth, h the ratio of the point's to it.  The centres c are linear in velocity,
gravity, and the accelerometer's bias and delay, so points are linear in ρ and in the products of ρ and these.
Gauss-Newton from rest fails where the path from rest leaves the scene: accelerations of a hand, integrated twice from
a wrong velocity, reach metres within a second.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from virest.image_formation.point_model import IntegratedMotion, Prediction, TrackTable, predict
from virest.inference.robust import CAUCHY, RAYLEIGH_MEDIAN, cauchy_weight
from virest.motion.scene_motion import DirectedMotion, InertialMotion

PASSES = 8
"""Of reweighting, and of h at the path found."""
FARTHEST_PER_M = 0.01
"""A plane at 100 m: before it a hand's translation moves no point."""
LEAST_CLEARANCE = 0.3
"""Smallest distance from the plane relative to that at the window's middle: a hand does not come closer."""


def linear_start(known: IntegratedMotion, table: TrackTable, at: Prediction, rest: InertialMotion) -> InertialMotion:
    """The motion that fits the points best beside its priors; ``rest`` where the scene is too far for any.

    at: the points predicted at ``rest``.
    """
    assert at.moved is not None
    assert at.moved.paths is not None
    first, second = at.moved.paths
    turned = predict(known, table, DirectedMotion(np.zeros((1, 3))), like=at)
    assert turned.per_step is not None
    noise_px, window, poses = table.noise_px[table.pair], table.window, at.poses
    axis = rest.plane_per_m / np.linalg.norm(rest.plane_per_m, axis=-1, keepdims=True)
    world = poses.before.to_world(known.lens.rays(table.first_px, poses.first_s, poses.first_exposure_s))
    towards = (axis[window] * world).sum(axis=-1)
    own = np.zeros((len(table), 3, rest.windows, 3))
    own[np.arange(len(table)), :, window] = np.eye(3) * (first.since_s - second.since_s)[:, None, None]
    steps = [(first.path - second.path)[..., None], first.shared_slopes() - second.shared_slopes()]
    steps.append(own.reshape(len(table), 3, -1))
    flow = turned.per_step @ np.concatenate(steps, axis=-1) / noise_px[:, None, None]
    left = (table.second_px - turned.second_px) / noise_px[:, None]
    is_plane = np.zeros(len(rest.vector()), bool)
    is_plane[7:].reshape(-1, 6)[:, 3:] = True
    start_per_m = float(np.linalg.norm(rest.plane_per_m, axis=-1).mean())
    # the priors: ρ about its start, and each product about ρ times its value at rest
    rows = np.eye(1 + int((~is_plane).sum()))
    rows[1:, 0] = -rest.vector()[~is_plane]
    std = np.concatenate([[rest.plane_std_per_m[2]], start_per_m * rest.prior_std()[~is_plane]])
    prior, right = (rows / std[:, None]).T @ (rows / std[:, None]), np.eye(len(rows))[0] * start_per_m / std[0] ** 2
    scene, weight = rest, np.ones(len(table))
    nearer = towards
    for _ in range(PASSES):
        design = flow * nearer[:, None, None]
        weighted = design * weight[:, None, None]
        normal = np.einsum("nik,nil->kl", weighted, design, optimize=True) + prior
        found = np.linalg.solve(normal, np.einsum("nik,ni->k", weighted, left) + right)
        if found[0] < FARTHEST_PER_M:
            return rest
        vector = rest.vector()
        vector[~is_plane] = found[1:] / found[0]
        scene = replace(rest.with_vector(vector), plane_per_m=found[0] * axis)
        squared = ((left - design @ found) ** 2).sum(axis=-1)
        scale = float(np.sqrt(np.median(squared))) / RAYLEIGH_MEDIAN
        weight = cauchy_weight(squared, CAUCHY * scale) / scale**2
        gone = (axis[window] * first.centre(scene, scene.velocity_m_s[window])).sum(axis=-1)
        nearer = towards / np.clip(1 - found[0] * gone, LEAST_CLEARANCE, 1 / LEAST_CLEARANCE)
    return scene
