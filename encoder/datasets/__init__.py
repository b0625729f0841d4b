"""Datasets: folders of posed videos or images, recognised by their content, as pixels and rays."""

from kpc.encoder.datasets.dataset import Dataset, Pictures
from kpc.encoder.datasets.loading import load_dataset
from kpc.encoder.datasets.pixel_cache import PixelCache
from kpc.encoder.datasets.rays import camera_rays, pixel_rays

__all__ = ["Dataset", "Pictures", "PixelCache", "camera_rays", "load_dataset", "pixel_rays"]
