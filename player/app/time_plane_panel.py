"""The panel of the time planes: a picture of one, with the playhead in it; a click goes to that time."""

import time as clock

import moderngl

from kpc.player.app.desktop import imgui
from kpc.player.app.imgui_renderer import ImGuiRenderer
from kpc.player.app.state import PlayerState
from kpc.player.app.time_plane_pictures import moving_part, time_plane_picture, time_planes
from kpc.player.app.widgets import ACCENT, em, panel, place_bar, tip, window_size

# Seconds between two updates of the picture while the scene arrives.
REFRESH_S = 0.5


class TimePlanePanel:
    """See the module.

    Attributes:
        number: the plane that is shown, as `time_planes` lists them.
    """

    def __init__(self, imgui_renderer: ImGuiRenderer, state: PlayerState) -> None:
        self.imgui_renderer, self.state = imgui_renderer, state
        self.number = len(state.scene.scales) - 1
        self._texture: moderngl.Texture | None = None
        self._low, self._high = (
            0.0,
            1.0,
        )  # shares of the picture's height, from its upper edge, between which something moves
        self._shown: tuple[int, int] | None = None  # plane and version of the stream
        self._made_at = 0.0

    def build(self, bottom: float) -> float:
        """Build the panel above `bottom`; return its upper edge, screen units."""
        state = self.state
        place_bar(bottom)
        with panel("time planes", fits_content=False):
            planes = time_planes(state.scene)
            self.number = min(self.number, len(planes) - 1)  # groups of a clip need not have equally many
            imgui.set_next_item_width(em(9))
            names = [f"{plane}, scale {scale + 1}" for plane, scale in planes]
            changed, number = imgui.combo("##plane", self.number, names)
            if changed:
                self.number = number
            imgui.same_line()
            texture, axis = self._update(planes), planes[self.number][0][0]
            extent = f"{1 - self._high:.0%} to {1 - self._low:.0%} of {axis}"
            imgui.text_disabled(f"time to the right, {extent} upwards")
            tip("What moves is a wave; what is static is grey")
            size = (imgui.get_content_region_avail()[0], min(em(7), 0.25 * window_size()[1]))
            corner = imgui.get_cursor_screen_pos()
            lower, upper = (0.0, self._low), (1.0, self._high)
            imgui.image(texture.glo, size, lower, upper)
            imgui.set_cursor_screen_pos(corner)
            imgui.invisible_button("##seek", size)
            if imgui.is_item_active():
                state.scrub(state.stream.time_of((imgui.get_mouse_pos()[0] - corner[0]) / max(size[0], 1.0)))
            x = corner[0] + state.stream.time_in(state.playback.time) * size[0]
            ends = (x, corner[1]), (x, corner[1] + size[1])
            imgui.get_window_draw_list().add_line(*ends, imgui.get_color_u32(ACCENT), max(em(0.12), 1.0))
            return bottom - imgui.get_window_height()

    def _update(self, planes: list[tuple[str, int]]) -> moderngl.Texture:
        """Return the texture, updated if another plane is chosen or more of it has arrived."""
        wanted = self.number, self.state.stream.version
        is_stale = wanted != self._shown and clock.monotonic() - self._made_at > REFRESH_S
        if self._texture is None or is_stale or (self._shown or (-1,))[0] != self.number:
            picture = time_plane_picture(self.state.scene, *planes[self.number])
            size = picture.shape[1], picture.shape[0]
            if self._texture is None or self._texture.size != size:
                if self._texture is not None:
                    self.imgui_renderer.drop_texture(self._texture)
                self._texture = self.imgui_renderer.make_texture(size)
            self._texture.write(picture.tobytes(), alignment=1)
            self._low, self._high = moving_part(picture)
            self._shown, self._made_at = wanted, clock.monotonic()
        return self._texture
