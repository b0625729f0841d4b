"""Pictures of several scenes by one camera as one picture: what is nearer covers what is farther."""

from collections.abc import Sequence

import numpy as np

from kpc.format.scene.scene import Clip
from kpc.player.cpu.reference import Rendering


def in_depth_order(pictures: Sequence[Rendering]) -> Rendering:
    """Lay pictures over each other, pixel by pixel, from the nearest to the farthest.

        rgb = sum over k of T_k rgb_k,    opacity = 1 - T,    depth = sum over k of T_k a_k z_k / sum over k of T_k a_k

    with opacities a_k, mean depths z_k where they are finite, and T_k the product of 1 - a_j over the pictures j that
    are nearer than k. Each scene is taken for a surface at its mean depth, so that scenes that pass through each other
    within a pixel, or within something half transparent, are one before the other.

    Args:
        pictures: over black, all of one size.
    """
    depth = np.stack([picture.depth for picture in pictures])
    order = np.argsort(depth, axis=0, kind="stable")
    depth, opacity = (
        np.take_along_axis(values, order, axis=0)
        for values in (depth, np.stack([picture.opacity for picture in pictures]))
    )
    rgb = np.take_along_axis(np.stack([picture.rgb for picture in pictures]), order[..., None], axis=0)
    seen = np.cumprod(np.concatenate([np.ones_like(opacity[:1]), 1 - opacity[:-1]]), axis=0)
    weight = seen * opacity
    total, has_depth = weight.sum(axis=0), np.isfinite(depth)
    distance, placed = (weight * np.where(has_depth, depth, 0)).sum(axis=0), (weight * has_depth).sum(axis=0)
    mean = np.divide(distance, placed, out=np.full_like(total, np.inf), where=placed > 0)
    samples = np.sum([picture.samples for picture in pictures], axis=0)
    return Rendering((seen[..., None] * rgb).sum(axis=0), mean, total, np.asarray(samples))


def played_clip(first: Clip, others: Sequence[Clip]) -> Clip:
    """Return the time axis of several scenes together: that of the first, or, if it is still, of the longest one."""
    return first if first.frame_count > 1 else max([first, *others], key=lambda clip: clip.duration_s)


def same_moment(time: float, clip: Clip, other: Clip) -> float:
    """Return the time of another clip, in [0, 1], that began together with a clip; its last frame stays.

    Args:
        time: in [0, 1] over the clip.
        clip: the one that is played.
        other: the other one, which may be the same.
    """
    if other is clip:
        return time
    return min(time * clip.duration_s / other.duration_s, 1.0) if other.duration_s > 0 else 0.0
