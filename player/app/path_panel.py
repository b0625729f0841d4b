"""The panel of the camera path: its keyframes, and buttons to follow, record and save it."""

import contextlib

from kpc.format.common.errors import DatasetError
from kpc.player.app.actions import Actions
from kpc.player.app.desktop import imgui
from kpc.player.app.path_follower import MAX_GAP_S, MIN_GAP_S
from kpc.player.app.state import PlayerState
from kpc.player.app.widgets import MARGIN_EM, PANEL_EM, SPACING_EM, em, panel, place_next, tip, window_size

# What the panel says before there are keyframes.
NO_KEYFRAMES = "No keyframes yet. Move the camera and\npress K, at least twice, or drop a\nsaved path on the window."
# Keyframes that are visible without scrolling.
VISIBLE_KEYFRAMES = 8
# The slider along a path ends at least this long after its start, for ImGui refuses an empty range.
MIN_RANGE_S = 1e-3


class PathPanel:
    """See the module."""

    def __init__(self, state: PlayerState, actions: Actions) -> None:
        self.state, self.actions = state, actions

    def build(self, top: float, bottom: float) -> float:
        """Build the panel on the right between two heights, screen units; return where something below it begins."""
        place_next(window_size()[0] - em(MARGIN_EM), top, 1.0, 0.0, max_height=bottom - top, min_width=em(PANEL_EM))
        with panel("path", scrolls=True):
            self._content()
            return top + imgui.get_window_height() + em(SPACING_EM)

    def _content(self) -> None:
        """What can be done with the path, the position on it, and its keyframes."""
        follower, actions = self.state.follower, self.actions
        if imgui.button("add"):
            actions.add_keyframe()
        tip("Add a keyframe: the present camera and time (K)")
        imgui.same_line()
        imgui.begin_disabled(follower.is_empty)
        if imgui.button("stop" if follower.is_active and not actions.filming.is_along_path else "follow"):
            actions.follow_or_stop()
        imgui.same_line()
        if imgui.button("record"):
            actions.start_or_stop_filming(along_path=True)
        imgui.same_line()
        if imgui.button("save"):
            actions.save_path()
        imgui.end_disabled()
        if follower.is_empty:
            imgui.text_disabled(NO_KEYFRAMES)
            return
        self._slider()
        row = imgui.get_frame_height_with_spacing()
        count = len(follower.path.keyframes)
        if imgui.begin_child("##keyframes", (0, row * min(count, VISIBLE_KEYFRAMES))):
            for number in range(count):
                imgui.push_id(number)
                self._keyframe(number)
                imgui.pop_id()
        imgui.end_child()

    def _slider(self) -> None:
        """The position on the path."""
        path, present = self.state.follower.path, self.state.follower.position_s
        imgui.set_next_item_width(-1)
        end_s = max(path.end_s, path.start_s + MIN_RANGE_S)
        changed, position_s = imgui.slider_float(
            "##position",
            min(max(present, path.start_s), path.end_s),
            path.start_s,
            end_s,
            "%.1f s",
            imgui.SliderFlags.NO_INPUT,
        )
        if changed:
            self.actions.to_path_position(position_s)

    def _keyframe(self, number: int) -> None:
        """A row of the list: go there, seconds since the keyframe before, the clip's time in seconds, remove."""
        follower = self.state.follower
        if number >= len(follower.path.keyframes):
            return  # a keyframe before it has just been removed
        keyframe = follower.path.keyframes[number]
        if imgui.button(f"{number + 1}", (em(2), 0)):
            self.actions.to_path_position(float(keyframe.at_s or 0.0))
        tip("Go to this keyframe")
        imgui.same_line()
        imgui.set_next_item_width(em(5))
        if number:
            gap_s = float(keyframe.at_s or 0.0) - float(follower.path.keyframes[number - 1].at_s or 0.0)
            changed, gap_s = imgui.drag_float(
                "##gap", gap_s, 0.05, MIN_GAP_S, MAX_GAP_S, "+%.1f s", imgui.SliderFlags.NO_INPUT
            )
            if changed:
                with contextlib.suppress(DatasetError):  # the path would be too long
                    follower.path = follower.path.spaced(number, max(gap_s, MIN_GAP_S))
            tip("Seconds since the keyframe before; drag to change")
        else:
            imgui.dummy((em(5), 0))
        imgui.same_line()
        clip = self.state.stream.clip
        imgui.text_disabled(f"clip {keyframe.time * clip.duration_s:.2f} s")
        tip(f"Time of the clip: frame {keyframe.time * (clip.frame_count - 1):.1f} of {clip.frame_count}, from 0")
        imgui.same_line()
        if imgui.button("x", (em(1.8), 0)):
            follower.remove(number)
        tip("Remove this keyframe")
