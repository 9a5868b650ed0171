"""prototype"""
from typing import NamedTuple
import numpy as np


class Samples(NamedTuple):
    points: np.ndarray
    labels: np.ndarray


def sample_queries(shape, settings, rng):
    boxes = shape.boxes()
    k = settings.per_segment // 2
    n = k * settings.oversample
    P, L = [], []
    for i in range(shape.count):
        low, high = boxes[i]
        m = (high - low) * settings.box_margin / 2
        ins, out, insl, outl = [], [], 0, 0
        while insl < n or outl < n:
            c = rng.uniform(low - m, high + m, size=(1024, low.shape[0]))
            lab = shape.label(c)
            a, b = lab == i + 1, lab == 0
            ca, cb = np.cumsum(a) + insl, np.cumsum(b) + outl
            done = np.flatnonzero((ca >= n) & (cb >= n))
            end = done[0] + 1 if len(done) else len(c)
            ins.append(c[:end][a[:end]]); out.append(c[:end][b[:end]])
            insl, outl = insl + len(ins[-1]), outl + len(out[-1])
        for group, label in ((np.concatenate(ins), i + 1), (np.concatenate(out), 0)):
            if len(group) > k:
                d = shape.segment_distance(i, group)
                group = group[np.argpartition(d, k - 1)[:k]]
            P.append(group); L.append(np.full(k, label, np.uint8))
    low, high = boxes[:, 0].min(0), boxes[:, 1].max(0)
    extra = round(settings.uniform_fraction * settings.per_segment * shape.count)
    c = rng.uniform(low, high, size=(extra, low.shape[0]))
    P.append(c); L.append(shape.label(c))
    return Samples(np.concatenate(P), np.concatenate(L))
