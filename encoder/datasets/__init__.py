"""Folders of posed videos or images, recognised by their content, as pixels and rays."""

from kpc.encoder.datasets.dataset import Dataset, Pictures, load_dataset, rays, rays_of_camera
from kpc.encoder.datasets.pixel_cache import PixelCache

__all__ = ["Dataset", "PixelCache", "Pictures", "load_dataset", "rays", "rays_of_camera"]
