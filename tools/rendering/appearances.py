"""The appearance embedding that pictures are rendered with."""

import os
from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np

from kpc.format.common.errors import UsageError
from kpc.format.common.text import agreeing, counted
from kpc.format.container.groups import GroupedScene
from kpc.format.scene.scene import Scene, common_names

# Returns the embedding that a scene is rendered with; None for the average.
Chosen = Callable[[Scene], np.ndarray | None]


def appearance_in(
    loaded: Scene | GroupedScene, text: str | None, times: Iterable[float], say: Callable[[str], None]
) -> Chosen:
    """Return what --appearance chooses in each scene that is shown at these times; the average without the option.

    Groups without any appearance are rendered with their average among others that have some; `say` is called with
    that, once.

    Raises:
        UsageError: the appearance is not in all groups that have any, or a share lies outside [0, 1].
    """
    if text is None:
        return lambda scene: None
    first = loaded.at(0.0)[0]
    known = [first.appearances] if isinstance(loaded, Scene) else loaded.appearances_at(times)
    names, bare = set(common_names(known)), sum(not group for group in known)
    if not names and bare < len(known):
        raise UsageError(
            f"--appearance {text}: the groups have no appearance in common; render without one, or less of the clip"
        )

    def chosen(scene: Scene) -> np.ndarray | None:
        # Names that are not in all groups are no choice, nor do they make a shortened one ambiguous.
        shared = tuple(one for one in scene.appearances if one.name in names)
        return _appearance_of(replace(scene, appearances=shared), text) if shared or not names else None

    try:
        chosen(replace(first, appearances=next(filter(None, known), ())))
    except UsageError as error:
        is_partial = any(one.name not in names for group in known for one in group)
        raise UsageError(f"{error}{'; other names are in some groups only' if is_partial else ''}") from error
    if bare:
        where = f"{bare} of {counted(len(known), 'group')}, which {agreeing(bare, 'has', 'have')} no appearances"
        say(f"--appearance {text}: shows the average in {where}")
    return chosen


def _appearance_of(scene: Scene, text: str) -> np.ndarray:
    """Return the embedding that --appearance asks for.

    The text is NAME, or ONE:OTHER:SHARE for a linear interpolation; names themselves may contain colons.

    Raises:
        UsageError: the scene has no appearance of that name, or the share lies outside [0, 1].
    """
    names = {appearance.name for appearance in scene.appearances}
    names |= {os.path.splitext(name)[0] for name in names}  # which `Scene.appearance` takes, too
    pair, _, share = text.rpartition(":")
    if text in names or ":" not in pair:
        return scene.appearance(text)
    try:
        weight = float(share)
    except ValueError:
        weight = -1.0
    if not 0.0 <= weight <= 1.0:
        raise UsageError(f"--appearance {text}: {share!r} is not a share in [0, 1]; give NAME or NAME:NAME:SHARE")
    colons = [k for k, letter in enumerate(pair) if letter == ":"]
    split = next((k for k in colons if names.issuperset({pair[:k], pair[k + 1 :]})), colons[0])
    return scene.interpolate_appearance(pair[:split], pair[split + 1 :], weight)
