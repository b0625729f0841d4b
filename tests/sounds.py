"""Tiny sounds for tests, made by libav: tones that rise, and clicks whose place can be measured."""

from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import av
import numpy as np

from kpc.encoder.coding.scene_writer import encode
from kpc.format.coding.quantise import quantise_scene
from kpc.format.container import groups
from kpc.format.container.clip_sound import sample_at
from kpc.format.container.groups import GroupInput
from kpc.format.scene.scene import Clip
from kpc.format.scene.sound import SAMPLE_RATE, Sound
from scenes import tiny_scene


def sweep(seconds: float, low: float = 300.0, high: float = 3000.0, level: float = 0.3) -> np.ndarray:
    """Return a tone whose frequency rises, (N,) float32: every place sounds different."""
    t = np.arange(round(seconds * SAMPLE_RATE)) / SAMPLE_RATE
    return (level * np.sin(2 * np.pi * (low * t + (high - low) * t * t / (2 * seconds)))).astype(np.float32)


def with_noise(samples: np.ndarray, level_db: float) -> np.ndarray:
    """Return samples of which every other fifth of a second is silent, in noise of a level."""
    gate = np.arange(len(samples)) // (SAMPLE_RATE // 5) % 2
    noise = np.random.default_rng(0).normal(0, 10 ** (level_db / 20), len(samples))
    return (samples * gate + noise).astype(np.float32)


def write_track(path: Path, samples: np.ndarray, codec: str, rate: int = SAMPLE_RATE, start_s: float = 0.0) -> Path:
    """Write a sound file; samples (N,) or (N, 2)."""
    samples = samples.reshape(len(samples), -1)
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=rate)
        stream.layout = "mono" if samples.shape[1] == 1 else "stereo"
        for packet in coded(stream, samples, rate, start_s):
            container.mux(packet)
    return path


def coded(stream: av.AudioStream, samples: np.ndarray, rate: int, start_s: float = 0.0) -> list[av.Packet]:
    """Return the packets of samples at `rate`, the first of which is heard at `start_s`."""
    size, packets, layout = stream.codec_context.frame_size or 1024, [], stream.layout.name
    resampler = av.AudioResampler(stream.format.name, layout, rate)
    for start in range(0, len(samples), size):
        block = np.ascontiguousarray(samples[start : start + size], np.float32).reshape(1, -1)
        frame = av.AudioFrame.from_ndarray(block, format="flt", layout=layout)
        frame.sample_rate, frame.pts, frame.time_base = rate, round(start_s * rate) + start, Fraction(1, rate)
        for one in resampler.resample(frame):
            packets += stream.encode(one)
    return packets + stream.encode(None)


def add_track(video: Path, samples: np.ndarray, codec: str = "aac", start_s: float = 0.0) -> None:
    """Put a sound track into a video file, whose pictures are copied."""
    aside = video.with_name("aside" + video.suffix)
    with av.open(str(video)) as source, av.open(str(aside), "w") as container:
        pictures = container.add_stream_from_template(source.streams.video[0])
        stream = container.add_stream(codec, rate=SAMPLE_RATE)
        stream.layout = "mono" if samples.ndim == 1 else "stereo"
        packets = coded(stream, samples.reshape(len(samples), -1), SAMPLE_RATE, start_s)
        for packet in source.demux(source.streams.video[0]):
            if packet.dts is not None:
                packet.stream = pictures
                container.mux(packet)
        for packet in packets:
            container.mux(packet)
    aside.replace(video)


def decoded(sound: Sound) -> np.ndarray:
    """Return the samples of a sound, (N, channels) float32, by libopus, whose packed frames are 16-bit."""
    codec = av.CodecContext.create("libopus", "r")
    codec.sample_rate, codec.layout = SAMPLE_RATE, "mono" if sound.channels == 1 else "stereo"
    blocks = [frame.to_ndarray() for packet in sound.packets for frame in codec.decode(av.Packet(packet))]
    samples = np.concatenate(blocks, axis=1).reshape(-1, sound.channels) / np.float32(32768)
    return samples[sound.pre_skip :][: sound.sample_count]


def offset_of(found: np.ndarray, expected: np.ndarray, most: int = 4000) -> int:
    """Return by how many samples a sound is late against another, by their cross-correlation."""
    size = 1 << (len(found) + len(expected)).bit_length()
    product = np.fft.rfft(found, size) * np.fft.rfft(expected, size).conj()
    correlation = np.fft.irfft(product, size)
    return int(np.argmax(np.concatenate([correlation[-most:], correlation[:most]]))) - most


def scene_with_sound(sound: Sound, first: int, count: int) -> bytes:
    """Return a tiny scene of some frames of a clip of 10 fps, with their part of a sound."""
    scene = tiny_scene(scales=1, channels=2, resolution=(6, 5, 4), time=5)
    part = sound.part(sample_at(first, 10.0), sample_at(count, 10.0))
    scene = replace(scene, sound=part, clip=Clip(count, 10.0))
    return encode(quantise_scene(scene, [dict.fromkeys(scene.scales[0], 0.05)]))


def write_clip_with_sound(path: Path, sound: Sound) -> None:
    """Write a clip of 4 s in two groups, which share four frames in its middle."""
    groups.write([GroupInput.of(scene_with_sound(sound, first, 22), first) for first in (0, 18)], path)
