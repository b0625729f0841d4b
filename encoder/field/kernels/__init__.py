"""Fused CPU kernels of the K-Planes field: march, sample the planes, composite and back-propagate, ray by ray.

A batch of rays is never expanded into a batch of samples. Each worker marches its rays one by one, keeps the occupied
samples of the current ray in buffers that fit the cache, and adds gradients to a buffer of its own, so no locks are
needed. `kpc.encoder.field.field` and `kpc.encoder.field.render` state the same mathematics in plain PyTorch; the tests
compare the two.

Symbols in shape comments
    M   channels of a plane
    S   scales;  F = S * M features
    N   rays of a batch, or points
    u   coordinates in the planes, [0, 1]^3
    s   ray parameter: the distance along the ray, contracted where space is (`kpc.format.scene.space.Contraction`)

Modules
    compilation  how kernels are compiled
    arguments    named tuples that kernels take
    geometry     rays and occupancy cells
    vectors      weighted sums, products and exponentials of many numbers at a time
    texels       the texels of one scale's planes, and the nodes of the motion grid, around a point
    planes       sampling of all planes at a sample of a ray, and its transpose
    marching     one ray through the field; rendering; lists of samples
    backward     the gradient of a batch's loss
    points       features and densities at given points
    directions   the colour basis of rays
    updates      Adam, factors of rows and columns, and the gradients of the priors

Numba's on-disk cache notices a change in the file of the function that was called, not in the files of functions that
it calls: after editing a module here, delete `__pycache__`.
"""

from kpc.encoder.field.kernels.arguments import RAY_GRADIENTS, Gradients, PlaneSet, RayBatch, SampleArrays, Volume
from kpc.encoder.field.kernels.backward import backpropagate
from kpc.encoder.field.kernels.directions import colour_basis, colour_basis_transpose
from kpc.encoder.field.kernels.marching import collect_samples, render, weigh_samples
from kpc.encoder.field.kernels.points import features, log_densities, scatter_features
from kpc.encoder.field.kernels.texels import AXES, PLACES
from kpc.encoder.field.kernels.updates import adam, add_priors, line_gradients, scale_lines

__all__ = [
    "AXES",
    "PLACES",
    "RAY_GRADIENTS",
    "Gradients",
    "PlaneSet",
    "RayBatch",
    "SampleArrays",
    "Volume",
    "adam",
    "add_priors",
    "backpropagate",
    "collect_samples",
    "colour_basis",
    "colour_basis_transpose",
    "features",
    "line_gradients",
    "log_densities",
    "render",
    "scale_lines",
    "scatter_features",
    "weigh_samples",
]
