"""Dear ImGui, drawn with moderngl."""

import ctypes

import moderngl

from kpc.player.app.desktop import imgui
from kpc.player.app.fonts import system_font
from kpc.player.app.widgets import ACCENT, ROOM_EM
from kpc.player.gl import shader

# Height of the text, and a scale at which ImGui's default font is its vector font instead of the bitmap font.
FONT_SIZE, VECTOR_FONT_SCALE = 15.0, 2.0

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
        self.io.ini_filename = None  # write no files
        self.io.backend_flags |= imgui.BackendFlags.RENDERER_HAS_TEXTURES
        max_side = ctx.info["GL_MAX_TEXTURE_SIZE"]
        imgui.get_platform_io().renderer_texture_max_width = max_side
        imgui.get_platform_io().renderer_texture_max_height = max_side
        imgui.get_style().font_scale_main = VECTOR_FONT_SCALE  # which default font is added depends on it
        self._font = self.io.fonts.add_font_default()
        if (more := system_font()) is not None:  # for characters that the default font lacks
            merged = imgui.FontConfig()
            merged.merge_mode = True
            self.io.fonts.add_font_from_memory_ttf(more, font_cfg=merged)
        self._scale = 1.0
        _set_colours()
        _set_sizes(self._scale)
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
            content_scale: size of the text, pixels per pixel of a screen of ordinary density; less is used where the
                window lacks the room.
            seconds: since the last frame.
        """
        self._pixels = framebuffer
        ratio = framebuffer[0] / max(window[0], 1), framebuffer[1] / max(window[1], 1)
        self.io.display_size = window
        self.io.display_framebuffer_scale = ratio
        self.io.delta_time = max(seconds, 1e-4)
        room = min(side / (count * FONT_SIZE) for side, count in zip(window, ROOM_EM, strict=True))
        scale = max(min(content_scale / max(ratio[0], 1e-6), room), 0.5)
        if scale != self._scale:
            self._scale = scale
            _set_sizes(scale)
        imgui.new_frame()
        imgui.push_font(self._font, FONT_SIZE)

    def draw(self, framebuffer: moderngl.Framebuffer) -> None:
        """Draw the widgets built since `begin` over what the framebuffer holds."""
        imgui.pop_font()
        imgui.render()
        data = imgui.get_draw_data()
        self._update_textures()
        width, height = self._pixels  # moderngl does not follow changes of a window's own framebuffer
        framebuffer.use()
        framebuffer.viewport = (0, 0, width, height)
        display = self._program["display"]
        assert isinstance(display, moderngl.Uniform)  # for the type checker: the shader above declares it
        display.value = self.io.display_size
        self.ctx.enable_only(moderngl.BLEND)
        self.ctx.blend_func = moderngl.SRC_ALPHA, moderngl.ONE_MINUS_SRC_ALPHA
        across, down = data.framebuffer_scale
        for commands in data.commands_lists:
            self._upload(commands)
            for command in commands.commands:
                left, top, right, bottom = command.clip_rect
                x, y = int(left * across), int(height - bottom * down)
                w, h = int((right - left) * across), int((bottom - top) * down)
                if w <= 0 or h <= 0:
                    continue
                framebuffer.scissor = (max(x, 0), max(y, 0), w, h)
                self._textures[command.tex_ref.get_tex_id()].use(0)
                self._array.render(moderngl.TRIANGLES, vertices=command.elem_count, first=command.idx_offset)
        framebuffer.scissor = (0, 0, width, height)
        self.ctx.enable_only(moderngl.NOTHING)

    def end(self) -> None:
        """End a frame that is not drawn."""
        imgui.pop_font()
        imgui.end_frame()

    def make_texture(self, size: tuple[int, int]) -> moderngl.Texture:
        """Return an RGB texture of (width, height) that widgets can show as `texture.glo`."""
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
            texture.set_status(imgui.TextureStatus.DESTROYED)
        self.io.backend_flags &= ~imgui.BackendFlags.RENDERER_HAS_TEXTURES
        imgui.destroy_context(self._context)

    def _bind(self) -> moderngl.VertexArray:
        layout = [(self._vertices, "2f 2f 4f1", "position", "uv", "colour")]
        return self.ctx.vertex_array(
            self._program, layout, index_buffer=self._indices, index_element_size=imgui.INDEX_SIZE
        )

    def _upload(self, commands: imgui.DrawList) -> None:
        vertex_bytes = commands.vtx_buffer_size * imgui.VERTEX_SIZE
        index_bytes = commands.idx_buffer_size * imgui.INDEX_SIZE
        if vertex_bytes > self._vertices.size or index_bytes > self._indices.size:
            self._array.release()
            self._vertices.orphan(max(2 * vertex_bytes, self._vertices.size))
            self._indices.orphan(max(2 * index_bytes, self._indices.size))
            self._array = self._bind()
        self._vertices.write(ctypes.string_at(commands.vtx_buffer_data, vertex_bytes))
        self._indices.write(ctypes.string_at(commands.idx_buffer_data, index_bytes))

    def _update_textures(self) -> None:
        """Update the textures of glyphs, which ImGui rasterises when they are first used."""
        status = imgui.TextureStatus
        for wanted in imgui.get_platform_io().textures:
            if wanted.status == status.WANT_CREATE:
                texture = self.ctx.texture((wanted.width, wanted.height), 4, wanted.get_pixels().tobytes())
                self._textures[texture.glo] = texture
                wanted.set_tex_id(texture.glo)
                wanted.set_status(status.OK)
            elif wanted.status == status.WANT_UPDATES:
                self._textures[wanted.get_tex_id()].write(wanted.get_pixels().tobytes())
                wanted.set_status(status.OK)
            elif wanted.status == status.WANT_DESTROY and wanted.unused_frames > 0:
                self._textures.pop(wanted.get_tex_id()).release()
                wanted.set_tex_id(0)
                wanted.set_status(status.DESTROYED)


def _set_sizes(scale: float) -> None:
    """Set the sizes of all widgets.

    Args:
        scale: of the text and of all around it, 1 for a screen of ordinary density.
    """
    style = imgui.get_style()

    def scaled(x: float, y: float) -> tuple[float, float]:
        # Whole units, else a scroll bar appears where a rounded size lacks a fraction of one.
        return round(x * scale), round(y * scale)

    style.font_scale_main = scale
    style.window_rounding = style.frame_rounding = style.grab_rounding = 5.0 * scale
    style.scrollbar_rounding = style.popup_rounding = 5.0 * scale
    style.window_border_size = 0.0
    style.grab_min_size, style.scrollbar_size = scaled(12, 14)
    style.window_padding = scaled(10, 8)
    style.frame_padding = scaled(4, 3)
    style.item_spacing = scaled(8, 5)
    style.item_inner_spacing = scaled(4, 4)
    style.cell_padding = scaled(8, 2)


def _set_colours() -> None:
    """Set the colours of all widgets."""
    imgui.style_colors_dark()
    style = imgui.get_style()
    style.colors[imgui.Col.WINDOW_BG] = (0.06, 0.07, 0.09, 0.72)
    style.colors[imgui.Col.TEXT_DISABLED] = (0.74, 0.76, 0.80, 1.0)
    style.colors[imgui.Col.FRAME_BG] = (1.0, 1.0, 1.0, 0.10)
    style.colors[imgui.Col.FRAME_BG_HOVERED] = (1.0, 1.0, 1.0, 0.16)
    style.colors[imgui.Col.FRAME_BG_ACTIVE] = (1.0, 1.0, 1.0, 0.20)
    style.colors[imgui.Col.BUTTON] = (1.0, 1.0, 1.0, 0.10)
    style.colors[imgui.Col.BUTTON_HOVERED] = (1.0, 1.0, 1.0, 0.22)
    style.colors[imgui.Col.BUTTON_ACTIVE] = ACCENT
    style.colors[imgui.Col.CHECK_MARK] = ACCENT
    style.colors[imgui.Col.CHECKBOX_SELECTED_BG] = style.colors[imgui.Col.FRAME_BG]
    # The text of a slider lies over its grab.
    style.colors[imgui.Col.SLIDER_GRAB] = (*ACCENT[:3], 0.40)
    style.colors[imgui.Col.SLIDER_GRAB_ACTIVE] = (*ACCENT[:3], 0.55)
