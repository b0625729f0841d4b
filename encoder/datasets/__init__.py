"""Folders of posed videos or images, recognised by their content, as pixels and rays."""

from kpc.encoder.datasets.dataset import Dataset, Pictures, camera_rays, load_dataset, pixel_rays
from kpc.encoder.datasets.pixel_cache import PixelCache

__all__ = ["Dataset", "PixelCache", "Pictures", "load_dataset", "pixel_rays", "camera_rays"]
