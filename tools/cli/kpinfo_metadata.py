"""The lines of kpinfo on the metadata of a file."""

from collections.abc import Mapping, Sequence
from typing import Any

from kpc.format.common.text import counted, first_names
from kpc.format.scene.metadata import Metadata


def metadata_rows(metadata: Metadata, sizes: Sequence[Sequence[int]]) -> list[tuple[str, str]]:
    """Return labels and texts on what the file says of itself; none if it says nothing.

    Args:
        metadata: of the file.
        sizes: (width, height) of the pictures of the scene's cameras, which the metadata name; empty if not known.
    """
    document = metadata.document
    rows: list[tuple[str, str]] = []
    for name in ("title", "description", "author", "licence", "date"):
        lines = str(document.get(name, "")).split("\n")
        rows += [(name if not k else "", line) for k, line in enumerate(lines) if line or k]
    rows += _view_rows(metadata)
    names = [f"{name} {w}x{h}" for name, (w, h) in zip(metadata.camera_names, sizes, strict=False)]
    names = names or list(metadata.camera_names)
    if names:
        rows.append(("names", first_names(names, "--json")))
    rows += _provenance_rows(metadata.provenance)
    return rows


def _view_rows(metadata: Metadata) -> list[tuple[str, str]]:
    document, parts = metadata.document, []
    if (opening := metadata.opening) is not None:
        eye = ", ".join(f"{x:.4g}" for x in opening.camera.camera_to_world[:3, 3])
        parts.append(f"opens at ({eye}), time {opening.time:g}")
    if "up" in document:
        parts.append("up ({})".format(", ".join(f"{x:.4g}" for x in document["up"])))
    if "metres_per_unit" in document:
        parts.append(f"a unit is {document['metres_per_unit']:g} m")
    if document.get("transparent"):
        parts.append("transparent")
    rows = [("view", "; ".join(parts))] if parts else []
    if (limits := document.get("view_limits")) is not None:
        (a0, a1), (e0, e1), (near, far) = limits["azimuth"], limits["elevation"], limits["distance"]
        focus = ", ".join(f"{x:.4g}" for x in limits["focus"])
        text = f"azimuth {a0:.4g} to {a1:.4g}, elevation {e0:.4g} to {e1:.4g} degrees, distance {near:.4g} to {far:.4g}"
        rows += [("limits", text), ("", f"around points within {limits['reach']:.4g} of ({focus})")]
    return rows


def _provenance_rows(provenance: Mapping[str, Any]) -> list[tuple[str, str]]:
    rows = []
    made = [str(provenance[name]) for name in ("encoder", "preset") if name in provenance]
    made += [f"seed {provenance['seed']:g}"] if "seed" in provenance else []
    made += [f"{name} {value}" for name, value in provenance.get("options", {}).items()]
    if made:
        rows.append(("made by", ", ".join(made)))
    if "dataset_sha256" in provenance:
        rows.append(("from", f"{provenance.get('layout', 'dataset')} {provenance['dataset_sha256']}"))
    held_out, quality = provenance.get("held_out", {}), []
    units = {"psnr_db": "PSNR {:.2f} dB", "ssim": "SSIM {:.4f}", "moving_psnr_db": "moving {:.2f} dB",
             "still_psnr_db": "still {:.2f} dB"}  # fmt: skip
    quality += [unit.format(held_out[name]) for name, unit in units.items() if name in held_out]
    quality += [f"over {counted(held_out['pictures'], 'picture')}"] if "pictures" in held_out else []
    if quality:
        rows.append(("held out", ", ".join(quality)))
    if "coding_loss_db" in provenance:
        rows.append(("coding loss", f"{provenance['coding_loss_db']:.3f} dB"))
    return rows + [("history" if not k else "", step) for k, step in enumerate(provenance.get("history", []))]
