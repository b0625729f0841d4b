"""What the shaders of a scene are compiled with: macros and constant arrays that describe its decoder and where its
planes lie."""

import numpy as np

from kpc.format.scene.scene import AnyDecoder, HybridDecoder, Scene
from kpc.player.areas import may_be_parts
from kpc.player.atlas import Layout, pad_to_multiple


def decoder_shape(decoder: AnyDecoder) -> dict[str, int]:
    """Return the macros of march.glsl that describe the decoder; HIDDEN is 0 for view-independent colour."""
    if isinstance(decoder, HybridDecoder):
        hidden_4, width_4 = -(-len(decoder.b1) // 4), -(-len(decoder.v_bias) // 4)
        return {"HYBRID": 1, "HIDDEN": 4 * hidden_4, "HIDDEN_4": hidden_4, "WIDTH": 4 * width_4, "WIDTH_4": width_4}
    return {"HYBRID": 0, "HIDDEN": len(decoder.b1) if decoder.w2.any() else 0, "HIDDEN_4": 0, "WIDTH_4": 0}


def planes_shape(scene: Scene, layout: Layout) -> dict[str, int]:
    """Return the macros of march.glsl that describe the planes."""
    layers = {f"LAYERS_{scale}": count for scale, count in enumerate(layout.layers)}
    first = {f"FIRST_{scale}": number for scale, number in enumerate(layout.first_layers)}
    parts = {f"PART_{scale}": int(is_part) for scale, is_part in enumerate(may_be_parts(scene))}
    shape = {"SCALES": layout.scales, "FEATURES": layout.features, "BASIS": 3 * layout.features}
    return shape | layers | first | parts


def decoder_arrays(decoder: AnyDecoder, scene: Scene, layout: Layout) -> dict[str, np.ndarray]:
    """Return the decoder's weights as march.glsl wants them, (N, 4) float32 each, features in the padded layout of the
    planes.

    Explicit decoder: density_weight (F / 4), w1 (H x 3: nine columns, then b1, then zeros), w2 (3 x F / 4 x H), b2 (3 x
        F / 4), density_bias (1,
    in x); w1 and w2 are left out where w2 is 0, that is, where colour is view-independent.

    Hybrid decoder, G and H padded with zeros to multiples of four: from_features (G x F / 4) is v, from_features_bias
    (G / 4) is v_bias, from_hidden (H x G / 4) is u; density_weight (G / 4), w1 (H x 3), w2 (3 x H / 4), b2 (1, in xyz),
    density_bias as above.
    """
    features = layout.features * 4
    columns = np.concatenate(
        [
            4 * first + np.arange(scale["xy"].shape[2])
            for first, scale in zip(layout.first_layers, scene.scales, strict=True)
        ]
    )

    def spread(weights: np.ndarray) -> np.ndarray:
        out = np.zeros((*weights.shape[:-1], features), np.float32)
        out[..., columns] = weights
        return out.reshape(*weights.shape[:-1], features // 4, 4)

    arrays = {"density_bias": np.array([decoder.density_bias, 0, 0, 0])}
    if isinstance(decoder, HybridDecoder):
        arrays |= {
            "from_features": pad_to_multiple(spread(decoder.v), 0),
            "from_features_bias": pad_to_multiple(decoder.v_bias, 0),
            "density_weight": pad_to_multiple(decoder.density_weight, 0),
            "w1": _direction_layer(decoder),
            "from_hidden": pad_to_multiple(pad_to_multiple(decoder.u, 0), 1),
            "w2": pad_to_multiple(decoder.w2, 1),
            "b2": np.append(decoder.b2, 0),
        }
    else:
        arrays |= {"density_weight": spread(decoder.density_weight), "b2": spread(decoder.b2)}
        if decoder.w2.any():
            arrays["w1"] = _direction_layer(decoder)[: len(decoder.b1)]
            arrays["w2"] = np.moveaxis(spread(np.moveaxis(decoder.w2, 2, 0)), 0, 2)
    return {name: np.ascontiguousarray(array, np.float32).reshape(-1, 4) for name, array in arrays.items()}


def block_arrays(scene: Scene, layout: Layout) -> dict[str, np.ndarray]:
    """Return where planes lie in an atlas, as march.glsl wants it.

    Returns:
        blocks: (3 scales, 4) float32, `Layout.texture_rectangle` of each plane.
        layer_widths: (3 scales,) float32, the width of one layer as a share of the atlas.
        last_texels: (scales, 4) float32, the last texel of the scale's planes along x, y and z, without upsampling.
        first_layers: (scales,) int32.
    """
    sizes = [(s["xy"].shape[1] - 1, s["xy"].shape[0] - 1, s["xz"].shape[0] - 1, 0) for s in scene.scales]
    return {
        "blocks": np.array([layout.texture_rectangle(block) for block in layout.blocks], np.float32),
        "layer_widths": np.array([block.width / layout.size[0] for block in layout.blocks], np.float32),
        "last_texels": np.array(sizes, np.float32),
        "first_layers": np.array(layout.first_layers, np.int32),
    }


def _direction_layer(decoder: AnyDecoder) -> np.ndarray:
    """Return w1 and b1 side by side, (H, 12), H padded to a multiple of four."""
    layer = np.concatenate([decoder.w1, decoder.b1[:, None], np.zeros((len(decoder.b1), 2))], axis=1)
    return pad_to_multiple(layer, 0)
