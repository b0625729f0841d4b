"""Interpolation in pictures, by kernels."""

from kpc.player.cpu.lanes import F, I, kernel_part


@kernel_part
def interpolate_pixel(picture, x, y, out):
    """Interpolate a (H, W, C) picture bilinearly at a point of its raster, to (C,); beyond its edges all is as at
    them."""
    height, width, channels = picture.shape
    x, y = min(max(x - F(0.5), F(0)), F(width - 1)), min(max(y - F(0.5), F(0)), F(height - 1))
    column, row = I(x), I(y)
    right, above = min(column + 1, width - 1), min(row + 1, height - 1)
    f, g = x - F(column), y - F(row)
    for channel in range(channels):
        low = picture[row, column, channel] + f * (picture[row, right, channel] - picture[row, column, channel])
        high = picture[above, column, channel] + f * (picture[above, right, channel] - picture[above, column, channel])
        out[channel] = low + g * (high - low)
