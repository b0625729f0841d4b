"""Dear ImGui, drawn with moderngl."""

import ctypes

import moderngl
import numpy as np

from kpc.player.app.desktop import imgui
from kpc.player.app.widgets import ACCENT
from kpc.player.gl import shader

_VERTEX = f"""{shader.Language.DESKTOP.value}
uniform vec2 display;
in vec2 position;
in vec2 uv;
in vec4 colour;
out vec2 texture_position;
out vec4 tint;
void main() {{
    texture_position = uv;
    tint = colour;
    gl_Position = vec4(position.x / display.x * 2.0 - 1.0, 1.0 - position.y / display.y * 2.0, 0.0, 1.0);
}}
"""
_FRAGMENT = f"""{shader.Language.DESKTOP.value}
uniform sampler2D sheet;
in vec2 texture_position;
in vec4 tint;
out vec4 result;
void main() {{ result = tint * texture(sheet, texture_position); }}
"""


class ImGuiRenderer:
    """The ImGui context of one window: pass events to `io`, build widgets after `begin`, then `draw`.

    Args:
        ctx: the OpenGL context.

    Attributes:
        io: where ImGui takes events.
    """

    def __init__(self, ctx: moderngl.Context) -> None:
        self.ctx = ctx
        self._context = imgui.create_context()
        imgui.set_current_context(self._context)  # there may be another one
        self.io = imgui.get_io()
        self.io.set_ini_filename("")  # write no files
        self.io.backend_flags |= imgui.BackendFlags_.renderer_has_textures
        max_side = ctx.info["GL_MAX_TEXTURE_SIZE"]
        imgui.get_platform_io().renderer_texture_max_width = max_side
        imgui.get_platform_io().renderer_texture_max_height = max_side
        self.io.fonts.add_font_default_vector()
        _style()
        self._program = ctx.program(vertex_shader=_VERTEX, fragment_shader=_FRAGMENT)
        self._vertices = ctx.buffer(reserve=1 << 16, dynamic=True)
        self._indices = ctx.buffer(reserve=1 << 16, dynamic=True)
        self._textures: dict[int, moderngl.Texture] = {}
        self._array = self._bind()
        self._pixels = (0, 0)

    def begin(
        self, window: tuple[int, int], framebuffer: tuple[int, int], content_scale: float, seconds: float
    ) -> None:
        """Start a frame.

        Args:
            window: (width, height) of the window, screen units.
            framebuffer: (width, height) of the window, pixels.
            content_scale: size of the text, pixels per pixel of a screen of ordinary density.
            seconds: since the last frame.
        """
        self._pixels = framebuffer
        ratio = framebuffer[0] / max(window[0], 1), framebuffer[1] / max(window[1], 1)
        self.io.display_size = imgui.ImVec2(*window)
        self.io.display_framebuffer_scale = imgui.ImVec2(*ratio)
        self.io.delta_time = max(seconds, 1e-4)
        imgui.get_style().font_scale_dpi = max(content_scale / max(ratio[0], 1e-6), 0.5)
        imgui.new_frame()

    def draw(self, framebuffer: moderngl.Framebuffer) -> None:
        """Draw the widgets built since `begin` over what the framebuffer holds."""
        imgui.render()
        data = imgui.get_draw_data()
        self._update_textures()
        width, height = self._pixels  # moderngl does not follow changes of a window's own framebuffer
        framebuffer.use()
        framebuffer.viewport = (0, 0, width, height)
        display = self._program["display"]
        assert isinstance(display, moderngl.Uniform)  # for the type checker: the shader above declares it
        display.value = (data.display_size.x, data.display_size.y)
        self.ctx.enable_only(moderngl.BLEND)
        self.ctx.blend_func = moderngl.SRC_ALPHA, moderngl.ONE_MINUS_SRC_ALPHA
        scale = data.framebuffer_scale
        for commands in data.cmd_lists:
            self._upload(commands)
            for command in commands.cmd_buffer:
                left, top, right, bottom = command.clip_rect
                x, y = int(left * scale.x), int(height - bottom * scale.y)
                w, h = int((right - left) * scale.x), int((bottom - top) * scale.y)
                if w <= 0 or h <= 0:
                    continue
                framebuffer.scissor = (max(x, 0), max(y, 0), w, h)
                self._textures[command.tex_ref.get_tex_id()].use(0)
                self._array.render(moderngl.TRIANGLES, vertices=command.elem_count, first=command.idx_offset)
        framebuffer.scissor = (0, 0, width, height)
        self.ctx.enable_only(moderngl.NOTHING)

    def end(self) -> None:
        """End a frame that is not drawn."""
        imgui.end_frame()

    def make_texture(self, size: tuple[int, int]) -> moderngl.Texture:
        """Return an RGB texture of (width, height) that widgets can show as `imgui.ImTextureRef(texture.glo)`."""
        texture = self.ctx.texture(size, 3, alignment=1)
        self._textures[texture.glo] = texture
        return texture

    def drop_texture(self, texture: moderngl.Texture) -> None:
        """Release a texture of `make_texture`."""
        self._textures.pop(texture.glo).release()

    def close(self) -> None:
        """Destroy the ImGui context."""
        imgui.set_current_context(self._context)
        for texture in imgui.get_platform_io().textures:
            texture.set_tex_id(0)
            texture.status = imgui.ImTextureStatus.destroyed
        self.io.backend_flags &= ~imgui.BackendFlags_.renderer_has_textures
        imgui.destroy_context(self._context)

    def _bind(self) -> moderngl.VertexArray:
        layout = [(self._vertices, "2f 2f 4f1", "position", "uv", "colour")]
        return self.ctx.vertex_array(
            self._program, layout, index_buffer=self._indices, index_element_size=imgui.INDEX_SIZE
        )

    def _upload(self, commands: imgui.ImDrawList) -> None:
        vertices, indices = commands.vtx_buffer, commands.idx_buffer
        vertex_bytes, index_bytes = vertices.size() * imgui.VERTEX_SIZE, indices.size() * imgui.INDEX_SIZE
        if vertex_bytes > self._vertices.size or index_bytes > self._indices.size:
            self._array.release()
            self._vertices.orphan(max(2 * vertex_bytes, self._vertices.size))
            self._indices.orphan(max(2 * index_bytes, self._indices.size))
            self._array = self._bind()
        self._vertices.write(ctypes.string_at(vertices.data_address(), vertex_bytes))
        self._indices.write(ctypes.string_at(indices.data_address(), index_bytes))

    def _update_textures(self) -> None:
        """Update the textures of glyphs, which ImGui rasterises when they are first used."""
        status = imgui.ImTextureStatus
        for wanted in imgui.get_platform_io().textures:
            if wanted.status == status.want_create:
                texture = self.ctx.texture((wanted.width, wanted.height), 4, _texels(wanted).tobytes())
                self._textures[texture.glo] = texture
                wanted.set_tex_id(texture.glo)
                wanted.status = status.ok
            elif wanted.status == status.want_updates:
                self._textures[wanted.tex_id].write(_texels(wanted).tobytes())
                wanted.status = status.ok
            elif wanted.status == status.want_destroy and wanted.unused_frames > 0:
                self._textures.pop(wanted.tex_id).release()
                wanted.set_tex_id(0)
                wanted.status = status.destroyed


def _texels(texture: imgui.ImTextureData) -> np.ndarray:
    return np.asarray(texture.get_pixels_array())


def _style() -> None:
    """Set colours and sizes of all widgets."""
    imgui.style_colors_dark()
    style = imgui.get_style()
    style.window_rounding = style.frame_rounding = style.grab_rounding = 5.0
    style.window_border_size = 0.0
    style.window_padding = imgui.ImVec2(10, 8)
    style.item_spacing = imgui.ImVec2(8, 5)
    style.font_size_base = 15.0
    style.set_color_(imgui.Col_.window_bg, imgui.ImVec4(0.06, 0.07, 0.09, 0.72))
    style.set_color_(imgui.Col_.text_disabled, imgui.ImVec4(0.74, 0.76, 0.80, 1.0))
    style.cell_padding = imgui.ImVec2(8, 2)
    style.set_color_(imgui.Col_.frame_bg, imgui.ImVec4(1.0, 1.0, 1.0, 0.10))
    style.set_color_(imgui.Col_.frame_bg_hovered, imgui.ImVec4(1.0, 1.0, 1.0, 0.16))
    style.set_color_(imgui.Col_.frame_bg_active, imgui.ImVec4(1.0, 1.0, 1.0, 0.20))
    style.set_color_(imgui.Col_.button, imgui.ImVec4(1.0, 1.0, 1.0, 0.10))
    style.set_color_(imgui.Col_.button_hovered, imgui.ImVec4(1.0, 1.0, 1.0, 0.22))
    style.set_color_(imgui.Col_.button_active, ACCENT)
    style.set_color_(imgui.Col_.check_mark, ACCENT)
    # The text of a slider lies over its grab.
    style.set_color_(imgui.Col_.slider_grab, imgui.ImVec4(ACCENT.x, ACCENT.y, ACCENT.z, 0.40))
    style.set_color_(imgui.Col_.slider_grab_active, imgui.ImVec4(ACCENT.x, ACCENT.y, ACCENT.z, 0.55))
