"""Coding a finished checkpoint or a .kpc file anew, without pictures and without training."""

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from kpc.encoder.cli.options import Options
from kpc.encoder.cli.shared_in_file import SharedInFile
from kpc.encoder.cli.work_folder import is_own_file
from kpc.encoder.field.config import TrainConfig
from kpc.encoder.rdo import codec_model
from kpc.encoder.rdo.rate_control import Trade
from kpc.format.common import cli
from kpc.format.common.errors import TrainingError, UsageError
from kpc.format.common.text import notice
from kpc.format.common.version import VERSION
from kpc.format.container import groups, rewriting, scene_io
from kpc.format.container.metadata_options import with_view_limits
from kpc.format.container.rewriting import with_metadata
from kpc.format.scene.metadata import HISTORY_LIMIT, Metadata

# What losses are measured on, of a checkpoint and of a .kpc file.
EVALUATED_ON = ("training views", "views of its own, assumed to be right to 30 dB")


def transcode(options: Options) -> dict[str, Any]:
    """Code the source anew so that it meets `options.trade`, and write the file.

    Returns:
        What was measured, as a dictionary that JSON can hold.

    Raises:
        UsageError, TrainingError, FormatError: the source cannot be used (`kpc.encoder.rdo.codec_model.load`), or the
            target is too small.
    """
    started = time.monotonic()
    check_outputs(options)
    clip = open_source(options)
    if clip is not None and not clip.is_single:
        return _transcode_groups(options, clip) | {"encode_s": time.monotonic() - started}
    source = replace(codec_model.load(options.source), shown=True)
    before, metadata = source.scene.metadata, _with_history(source.scene.metadata, options)
    source = replace(
        source,
        scene=replace(source.scene, metadata=metadata),
        coded=None if source.coded is None else replace(source.coded, metadata=metadata),
    )
    coded = codec_model.code(source, options.trade, TrainConfig().prune_share, _tune_steps(options))
    data = coded.data
    is_copy = coded.scene is source.coded
    if is_copy:
        data = with_metadata(min(options.source.read_bytes(), data, key=len), _with_members(before, options))
    size = rewriting.save(data, options.output)
    return {
        "file": str(options.output), "source": str(options.source), "is_copy": is_copy,
        **coding_figures(coded, size, options.trade, EVALUATED_ON[clip is not None]),
        "encode_s": time.monotonic() - started,
    }  # fmt: skip


def open_source(options: Options) -> groups.Groups | None:
    """Open the file that is to be coded anew, of which little is read; None if it is a checkpoint.

    Raises:
        UsageError: it is neither a .kpc file nor a checkpoint, or the options do not apply to it.
        FormatError: it cannot be read, or its end is missing.
    """
    if not codec_model.is_coded(options.source):
        return None
    if options.trade.psnr_db is not None:
        raise UsageError(
            f"--psnr: {options.source} holds no filmed pictures to compare with; give its checkpoint, or --quality"
        )
    return groups.Groups(options.source)


def _with_history(metadata: Metadata, options: Options) -> Metadata:
    """Return the metadata of what is coded anew: figures that were measured do not hold any more."""
    name, value = options.trade.bound
    history = [*metadata.provenance.get("history", []), f"coded anew by kpc {VERSION}: {name} {value:g}"]
    changed = _with_members(metadata, options)
    return changed.with_provenance(held_out=None, coding_loss_db=None, history=history[-HISTORY_LIMIT:])


def _with_members(metadata: Metadata, options: Options) -> Metadata:
    """Return the metadata of a copy, of which all figures that were measured hold, with what the options change."""
    changed = metadata.with_members(**options.members)
    return changed if options.view_limits is None else with_view_limits(changed, options.view_limits)


def _tune_steps(options: Options) -> int:
    return TrainConfig().tune_steps if options.tune_steps is None else options.tune_steps


def _transcode_groups(options: Options, source: groups.Groups) -> dict[str, Any]:
    """Code each group on its own. All coded groups are in memory together."""
    spans, parts, found, is_copy = source.timeline.spans, [], [], True
    clip = _with_history(source.metadata(), options)
    shared = SharedInFile.find(source)
    copied = with_metadata(options.source, _with_members(source.metadata(), options))
    # All groups fit then, however their sizes differ.
    fits = options.trade.target_bytes is not None and len(copied) <= options.trade.target_bytes

    def trade_of(number: int, alone: bool = False) -> Trade:
        return options.trade if fits else shared.trade_of(options, number, spans, alone)

    if options.trade.target_bytes is not None:  # a size that is too small for a late group is refused at once, too
        for number in range(len(spans)):
            codec_model.check_size(scene_io.read(source.open(number)), trade_of(number, alone=True), is_coded=True)
    for number, span in enumerate(spans):
        reader, trade = source.open(number), trade_of(number)
        metadata = _with_history(reader.metadata(), options)
        scene = replace(scene_io.read(reader), cameras=reader.cameras() or source.cameras(), metadata=metadata)
        notice(f"group {number} of {len(spans)}")
        model = replace(codec_model.model_from_file(scene), shown=True, sharing=shared.of_group(number))
        try:
            coded = codec_model.code(model, trade, TrainConfig().prune_share, _tune_steps(options))
        except TrainingError as error:
            what = f"group {number} of {len(spans)}, with the planes that it shares with others"
            raise TrainingError(f"{what}: {error}; each group has a share of the size by its frames") from error
        shared.settle(number, coded)
        is_copy = is_copy and coded.scene is model.coded
        parts.append(groups.GroupInput.of(coded.data, span.start))
        found.append(coding_figures(coded, coded.size_bytes, trade, EVALUATED_ON[1]))
    if is_copy:
        size = rewriting.save(copied, options.output)
    else:
        size = groups.write(parts, options.output, clip)
    return {
        "file": str(options.output),
        "source": str(options.source),
        "is_copy": is_copy,
        **combine_figures(found, spans, size, options.trade),
    }


def combine_figures(
    found: Sequence[dict[str, Any]], spans: Sequence[groups.Span], size: int, trade: Trade
) -> dict[str, Any]:
    """Combine the `coding_figures` of groups: sums, and means over frames."""
    frames, parameters = [span.count for span in spans], sum(one["parameters"] for one in found)
    means = {}
    for key in ("validation_psnr", "validation_loss_db", "agreement_db", "identity_share"):
        known = [(one[key], count) for one, count in zip(found, frames, strict=True) if one[key] is not None]
        means[key] = sum(value * count for value, count in known) / sum(count for _, count in known) if known else None
    name, value = trade.bound
    return {
        "trade": name,
        "target": value,
        "evaluated_on": found[0]["evaluated_on"],
        **means,
        "size_bytes": size,
        "parameters": parameters,
        "bits_per_parameter": 8 * size / parameters,
    }


def coding_figures(coded: codec_model.CodedModel, size: int, trade: Trade, evaluated_on: str) -> dict[str, Any]:
    """Return the figures that are reported for every file."""
    name, value = trade.bound
    return {
        "trade": name,
        "target": value,
        "evaluated_on": evaluated_on,
        "validation_psnr": coded.psnr,
        "validation_loss_db": coded.loss_db,
        "agreement_db": coded.agreement_db,
        "size_bytes": size,
        "parameters": coded.scene.parameter_count,
        "bits_per_parameter": 8 * size / coded.scene.parameter_count,
        "identity_share": coded.scene.identity_share if coded.scene.is_dynamic else None,
    }


def describe_target(result: dict[str, Any]) -> str:
    """Describe the target in words."""
    name, bound = result["trade"], result["target"]
    return {
        "max_loss_db": f"at most {bound:g} dB of loss",
        "target_bytes": f"at most {bound:,.0f} bytes",
        "quality": f"quality {bound:g}",
        "lam": f"lam {bound:g}",
        "psnr_db": f"at least {bound:g} dB",
    }[name]


def describe_outcome(result: dict[str, Any]) -> str:
    """Describe the target, and what was reached, in words."""
    loss = f"{result['validation_loss_db']:.3f} dB of loss on {result['evaluated_on']}"
    psnr = f"{result['validation_psnr']:.2f} dB, " if result["trade"] == "psnr_db" else ""
    return (
        f"asked for {describe_target(result)}; reached {result['size_bytes']:,} bytes, {psnr}{loss}, "
        f"{result['agreement_db']:.1f} dB against the uncoded pictures"
    )


def describe_copy(result: dict[str, Any]) -> str:
    """Say why the result is a copy of the source."""
    name = result["trade"]
    why = {"target_bytes": "it is small enough", "lam": "no file of less cost was found"}
    return (
        f"{result['size_bytes']:,} bytes, a copy of the source, since {why.get(name, 'no smaller file was found')} "
        f"(asked for {describe_target(result)})"
    )


def check_outputs(options: Options) -> None:
    """Check before training, which may take hours, that the output files can be written.

    Raises:
        UsageError, OSError: one cannot, would replace what is read, or would be removed with the work folder.
    """
    for output, option in ((options.output, "-o"), (options.keep_checkpoint, "--keep-checkpoint")):
        if output is None:
            continue
        cli.check_writable(output, option=option)
        cli.refuse_sources(output, *options.files_read, option=option)
        if is_own_file(output, options.work_dir):
            raise UsageError(f"{output}: is a name that kpenc uses in its work folder; choose another with {option}")
    if options.output.suffix.lower() != ".kpc":
        raise UsageError(f"{options.output}: kpenc writes .kpc files; end the name in .kpc")
