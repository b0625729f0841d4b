"""The jobs of a batch, from a TOML file or from folders, checked as a whole before anything starts.

output = "out"                        # a folder or an address
[options]                             # options of kpenc for all scenes, without their dashes
preset = "fast"
[grid]                                # all combinations of these
quality = [40, 70, 100]
[resources]                           # that each job takes
cores = 2
[[scene]]
source = "videos/take01"              # beside the file, or an address
options = { steps = 2000 }
"""

import argparse
import contextlib
import io
import itertools
import re
import tomllib
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kpc.format.common import cli
from kpc.format.common.errors import KpcError, UsageError
from kpc.format.container.groups import check_checksums
from kpc.tools.batch.toml_lines import TomlLines

if TYPE_CHECKING:
    from kpc.encoder.cli.options import Options

# Options of kpenc that a batch sets itself, or that make no sense in one: fields of kpenc's options, and all others.
REFUSED_FIELDS = ("output", "work", "keep", "resume", "only", "preview", "keep_checkpoint")
REFUSED = (*REFUSED_FIELDS, "o", "dry_run", "json", "version", "help", "h")
A_BATCHS_OWN = "a batch sets this option of kpenc itself; drop it"
TABLES = {"options", "grid", "resources"}
SCENE_KEYS = {"source", "name", "options", "resources"}
ADDRESS = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*://")
# Bytes: PyTorch alone takes more.
LEAST_MEMORY = 100_000_000
# Characters of names that are replaced in names of files.
UNSAFE = re.compile(r"[^\w.+-]+")


@dataclass(frozen=True)
class Resources:
    """What a job takes of a worker.

    Attributes:
        cores: processor cores, which it uses fully.
        memory: bytes; 0 if it was not said.
        gpus: graphics cards.
    """

    cores: int = 1
    memory: int = 0
    gpus: int = 0


@dataclass(frozen=True)
class Job:
    """A scene to encode, or a .kpc file to code anew, with one set of options.

    Attributes:
        name: of the result, without .kpc.
        source: a path or an address.
        options: of kpenc, as words of its command line.
        group: whether the clip is encoded in groups, each by itself.
        resources: that it takes, or each of its groups.
        where: in which file and line it stands, for messages.
    """

    name: str
    source: str
    options: tuple[str, ...] = ()
    group: bool = False
    resources: Resources = field(default_factory=Resources)
    where: str = ""


@dataclass(frozen=True)
class Batch:
    """Jobs, and the folder or address that their results go to."""

    jobs: tuple[Job, ...]
    output: str


class FaultyBatch(UsageError):
    """Something in a batch is wrong; `faults` has a line for each fault."""

    def __init__(self, faults: Sequence[str]) -> None:
        super().__init__("; ".join(faults))
        self.faults = tuple(faults)


class Faults:
    """Collects what is wrong with a batch, one line for each fault.

    Args:
        reads_files: whether .kpc files are to be read as a whole, and each is to be checked by its checksums.
    """

    def __init__(self, reads_files: bool = False) -> None:
        self._lines: dict[str, None] = {}
        self._reads_files, self._read = reads_files, set[str]()

    def add(self, where: str, text: str) -> None:
        self._lines[f"{where}: {text}"] = None

    def must_read(self, source: str) -> bool:
        """Return whether a file is still to be read as a whole, which it is once."""
        if not self._reads_files or source in self._read:
            return False
        self._read.add(source)
        return True

    def check(self, file: Path | None = None) -> None:
        """Raise FaultyBatch if there are faults, in the order in which they were added.

        Args:
            file: in whose lines they stand, by which they are sorted.
        """
        if self._lines:
            start = f"{file}:"
            raise FaultyBatch(
                list(self._lines)
                if file is None
                else sorted(self._lines, key=lambda line: int(line.removeprefix(start).partition(":")[0]))
            )


def read_jobs(path: Path, place: str | None = None, *, reads_files: bool = False) -> Batch:
    """Read a batch from a TOML file.

    Args:
        path: of the file.
        place: folder or address that the results go to in place of the file's own.
        reads_files: whether the checksums of .kpc files are checked, for which they are read as a whole.

    Raises:
        UsageError: it cannot be read.
        FaultyBatch: something in it is wrong, or a result would replace a source.
    """
    try:
        text = path.read_text(encoding="utf-8")
        document = tomllib.loads(text)
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise UsageError(f"{path}: {getattr(error, 'strerror', None) or error}") from error
    lines, faults = TomlLines(path, text), Faults(reads_files)
    for key in _unknown(document, TABLES | {"output", "scene"}):
        faults.add(lines.of(key), f"{key!r} is not known; known are output, scene, {', '.join(sorted(TABLES))}")
    output = document.get("output", place)
    has_output = isinstance(output, str) and bool(output)
    if not has_output:
        faults.add(lines.of("output"), 'output names the folder of the results; write for example output = "out"')
    scenes = document.get("scene", [])
    if not isinstance(scenes, list) or not scenes or not all(isinstance(scene, dict) for scene in scenes):
        faults.add(lines.of("scene"), 'there is no scene; write [[scene]], and below it source = "FOLDER"')
        scenes = []
    common = {table: _table(document, table, lines.of(table), faults) for table in TABLES}
    for key, values in common["grid"].items():
        if not isinstance(values, list) or not values:
            faults.add(
                lines.of(key, tables=("grid",)),
                f"{key} in the grid is not a list; write for example {key} = [40, 70, 100]",
            )
            common["grid"][key] = [values]
    jobs: list[Job] = []
    for number, scene in enumerate(scenes):
        jobs += _jobs_of(scene, number, common, path.parent, lines, faults)
    _check_names(jobs, "give the scene another name", faults)
    batch = Batch(tuple(jobs), resolve(str(output), path.parent) if place is None else resolve(place, Path()))
    if has_output:
        _check_results(batch, faults)
    faults.check(path)
    return batch


def jobs_of_folders(
    folders: Sequence[str], options: Sequence[str], resources: Resources, *, reads_files: bool = False
) -> tuple[Job, ...]:
    """Return a job for each folder, file or address, all with the same options of kpenc.

    Raises:
        FaultyBatch: an option is wrong, or a source is missing; or a .kpc file is damaged, if `reads_files`.
    """
    faults, here = Faults(reads_files), Path()
    jobs = []
    for folder in folders:
        source = resolve(folder, here)
        if _is_missing(source):
            faults.add(folder, "no such file or folder")
        job = Job(name_of(source), source, tuple(options), resources=resources, where=folder)
        jobs.append(_checked(job, faults))
    _check_names(jobs, "name them in a file of jobs, or give them to two commands with a folder -o each", faults)
    faults.check()
    return tuple(jobs)


def check_results(batch: Batch) -> None:
    """Refuse results that would replace a source.

    Raises:
        FaultyBatch: they would.
    """
    faults = Faults()
    _check_results(batch, faults)
    faults.check()


def _check_results(batch: Batch, faults: Faults) -> None:
    sources = [job.source for job in batch.jobs]
    paths = [Path(source) for source in sources if not ADDRESS.match(source)]
    for job in batch.jobs:
        result = f"{batch.output.rstrip('/')}/{job.name}.kpc"
        try:
            if not ADDRESS.match(result):
                cli.refuse_sources(Path(result), *paths)
            elif result in sources:
                raise UsageError(f"{result}: is the source, too; write elsewhere with -o")
        except UsageError as error:
            faults.add(job.where, str(error))


def memory_size(text: str) -> int:
    """Parse the memory of a job in bytes, as `cli.byte_count` does; refuse what no job can do with.

    Raises:
        argparse.ArgumentTypeError: it is no size, or too small.
    """
    size = cli.byte_count(text)
    if size < LEAST_MEMORY:
        raise argparse.ArgumentTypeError(f"{text!r} is less than any job takes; give 100MB or more, such as 3GB")
    return size


def resolve(text: str, folder: Path) -> str:
    """Return an address unchanged, and a path as an absolute one, relative to a folder."""
    return text if ADDRESS.match(text) else str((folder / text).expanduser().absolute())


def name_of(source: str) -> str:
    """Return the name of a result that is made of a path or an address."""
    last = source.rstrip("/").rsplit("/", 1)[-1]
    return UNSAFE.sub("_", Path(last).stem if last.endswith(".kpc") else last) or "scene"


def _table(document: Mapping[str, Any], name: str, where: str, faults: Faults) -> dict[str, Any]:
    found = document.get(name, {})
    if isinstance(found, dict):
        return found
    faults.add(where, f"{name} is not a table; write [{name}]")
    return {}


def _jobs_of(
    scene: dict[str, Any], number: int, common: Mapping[str, Any], folder: Path, lines: TomlLines, faults: Faults
) -> Iterator[Job]:
    """Yield the jobs of one [[scene]]: one for each point of the grid."""
    where = lines.of("scene", number)
    for key in _unknown(scene, SCENE_KEYS):
        faults.add(lines.of(key, number), f"{key!r} is not known; a scene has {', '.join(sorted(SCENE_KEYS))}")
    source, name = _source_and_name(scene, number, folder, lines, faults)
    own = _table(scene, "options", where, faults)
    taken = common["resources"] | _table(scene, "resources", where, faults)
    resources = _resources(taken, number, lines, faults)
    grid = {key: value for key, value in common["grid"].items() if key not in own}
    for point in itertools.product(*grid.values()):
        chosen = dict(zip(grid, point, strict=True))
        options = common["options"] | chosen | own
        parts = [name or "", *(f"{key}-{UNSAFE.sub('_', str(value))}" for key, value in chosen.items())]
        words = _words(options, number, lines, faults)
        job = Job(".".join(parts), source or "", tuple(words), resources=resources, where=where)
        checked = _checked(job, faults, words)
        if source is not None and name is not None:
            yield checked


def _source_and_name(
    scene: dict[str, Any], number: int, folder: Path, lines: TomlLines, faults: Faults
) -> tuple[str | None, str | None]:
    """Return the source of a scene and the name of its result, each None if it is wrong."""
    source: str | None = scene.get("source")
    if isinstance(source, str) and source:
        source = resolve(source, folder)
        if _is_missing(source):
            faults.add(lines.of("source", number), f"{source}: no such file or folder")
    else:
        faults.add(lines.of("scene", number), 'the scene has no source; write for example source = "videos/take01"')
        source = None
    name = scene.get("name", name_of(source or "scene"))
    unsafe = UNSAFE.search(name) if isinstance(name, str) else None
    if isinstance(name, str) and name and not unsafe:
        return source, name
    found = f"{unsafe.group()!r} cannot be in a name, " if unsafe else ""
    faults.add(lines.of("name", number), f"name = {name!r}: {found}which has letters, digits, and . _ + - only")
    return source, None


def _is_missing(source: str) -> bool:
    return not ADDRESS.match(source) and not Path(source).exists()


def _unknown(table: Mapping[str, Any], known: Collection[str]) -> list[str]:
    return [key for key in table if key not in known]


def _words(options: Mapping[str, Any], number: int, lines: TomlLines, faults: Faults) -> dict[str, str]:
    """Return options as words of a command line, and where each stands: those that are true without a value, and none
    that are false."""
    words = {}
    for key, value in options.items():
        name, where = key.replace("_", "-"), lines.of(key, number, ("grid", "options"))
        if name.replace("-", "_") in REFUSED:
            faults.add(where, f"{key}: {A_BATCHS_OWN}")
        elif value is True:
            words[f"--{name}"] = where
        elif isinstance(value, list) and value and all(isinstance(one, int | float) for one in value):
            words[f"--{name}={','.join(map(str, value))}"] = where
        elif isinstance(value, str | int | float) and value is not False:
            words[f"--{name}={value}"] = where
        elif value is not False:
            faults.add(where, f"{key}: {value!r} is not a value of an option")
    return words


def _resources(given: Mapping[str, Any], number: int, lines: TomlLines, faults: Faults) -> Resources:
    """Return the resources that a table names."""

    def add(key: str, text: str) -> None:
        faults.add(lines.of(key, number, ("resources",)), text)

    for key in _unknown(given, ("cores", "memory", "gpus")):
        add(key, f"{key!r} is not a resource; known are cores, memory and gpus")
    counts = {}
    for key, least in ("cores", 1), ("gpus", 0):
        value = given.get(key, least)
        if not isinstance(value, int) or isinstance(value, bool) or value < least:
            add(key, f"{key} = {value!r} is not a whole number from {least} on")
            value = least
        counts[key] = value
    memory = 0
    if "memory" in given:
        try:
            memory = memory_size(str(given["memory"]))
        except argparse.ArgumentTypeError as error:
            add("memory", f"memory: {error}")
    return Resources(counts["cores"], memory, counts["gpus"])


def _checked(job: Job, faults: Faults, places: Mapping[str, str] | None = None) -> Job:
    """Check a job as a whole, before anything starts.

    Its options are checked by kpenc's own parser, and its source by `_check_source`.

    Args:
        job: to be checked; its source is empty, or not there, if that is reported already.
        faults: gets what is wrong.
        places: the job's options, and the file and line of each; None if they stand where the job does.

    Returns:
        The job with what the options say about groups.
    """
    is_here = bool(job.source) and not ADDRESS.match(job.source) and Path(job.source).exists()
    if ADDRESS.match(job.source) and job.source.endswith(".kpc"):
        return job  # its options are checked once the file is there
    source, places = job.source if is_here else "folder", places or {}
    plain, unusable = _parsed(source, [])
    if plain is None:  # whatever the options are
        for fault in unusable:
            faults.add(job.where, fault.removeprefix(f"{job.source}: "))
        source, is_here = "folder", False
    options, wrong = _parsed(source, job.options)
    if is_here and any(fault.startswith(f"{job.source}: ") for fault in wrong):
        options, wrong = None, []  # what `_check_source` says of the source
    # The parser names only the first option that it refuses; some are refused only beside others.
    alone = [(place, fault) for word, place in places.items() for fault in _parsed(source, [word])[1]] if wrong else []
    for place, fault in alone or [(_place_of(fault, places) or job.where, fault) for fault in wrong]:
        faults.add(place, fault)
    if is_here and (given := options or plain) is not None:
        _check_source(job, given, faults)
    return job if options is None else replace(job, group=options.group_s is not None)


def _check_source(job: Job, options: "Options", faults: Faults) -> None:
    """Check a source on this machine, which must be a folder that holds something to encode, or a file that begins and
    ends as those that are coded anew; and whose checksums are right, if `faults` says that it must be read.
    """
    from kpc.encoder.cli.read_dataset import check_folder  # loads PyTorch, which workers need not
    from kpc.encoder.cli.transcode import open_source

    try:
        if not options.source.is_file():
            check_folder(options)
        elif (opened := open_source(options)) is not None and faults.must_read(job.source):
            check_checksums(opened)
    except (KpcError, OSError) as error:
        faults.add(job.where, (cli.message_of(error) or str(error)).removeprefix(f"{job.source}: "))


def _parsed(source: str, words: Sequence[str]) -> tuple["Options | None", list[str]]:
    """Parse words by kpenc's own parser; return its options, None if it refuses them, and what is wrong with them."""
    from kpc.encoder.cli import options as kpenc

    said, output = io.StringIO(), Path(".kpbatch", "scene.kpc")
    try:
        with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
            options, is_plan, is_json = kpenc.parse([source, "-o", str(output), *words])
    except SystemExit as stop:
        message = said.getvalue().strip().rsplit("error: ", 1)[-1]
        return None, [message if stop.code else f"--help and --version: {A_BATCHS_OWN}"]
    plain = kpenc.Options(options.source, output)
    given = [name for name in REFUSED_FIELDS if getattr(options, name) != getattr(plain, name)]
    given += ["dry_run"] * is_plan + ["json"] * is_json
    return options, [f"--{name.replace('_', '-')}: {A_BATCHS_OWN}" for name in given]


def _place_of(fault: str, places: Mapping[str, str]) -> str | None:
    """Return where the option stands that a fault names at its beginning."""
    named = re.match(r"(?:argument )?(--[\w-]+)", fault)
    return next((place for word, place in places.items() if named and word.split("=")[0] == named[1]), None)


def _check_names(jobs: Sequence[Job], remedy: str, faults: Faults) -> None:
    first: dict[str, Job] = {}
    for job in jobs:
        other = first.setdefault(job.name, job)
        if other is not job:
            faults.add(job.where, f"the name {job.name!r} is taken by {other.where}; {remedy}")
