"""Print how coded chunks decode, decision by decision, to compare another decoder with.

python -m decoder.trace                       prints the tables of sections 13.2 and 13.3
python -m decoder.trace scene.kpc NUMBER      prints the decisions of chunk NUMBER, from 0, of a file
"""

import sys

from . import decode, payloads, planes, predictive, transform
from .container import PREDICTIVE, TRANSFORM, Content, read_chunks
from .entropy import UNTRAINED, EntropyDecoder

PREDICTIVE_EXAMPLE = bytes.fromhex("01 01 04 f0 10 00 00 00 00 00 00 43 02 01 02 00 20")  # 2 rows of 3 texels
TRANSFORM_EXAMPLE = bytes.fromhex("04 00 28 f6 75 11 00 a1 41 91 10")  # 4 rows of 8 texels


class TracingDecoder(EntropyDecoder):
    """Notes each decision: (model, P, count, p, state before, bit, word read, state after)."""

    def __init__(self, chunk):
        super().__init__(chunk)
        self.stored, self.steps, self.model = chunk.data, [], None

    def decision(self, p):
        P, count = ("", "") if self.model is None else self.models.get(self.model, self.initial)
        state, first = self.state, self.next_word
        bit = super().decision(p)
        word = f"{self.words[first]:x}" if self.next_word > first else ""
        self.steps.append((spelled(self.model), P, count, p, f"{state:x}", bit, word, f"{self.state:x}"))
        return bit

    def adaptive(self, model, initial=UNTRAINED):
        self.model, self.initial = model, initial
        bit = super().adaptive(model, initial)
        self.model = None
        return bit


class Tracing:
    """Note the results of functions and the decisions of all chunks that are decoded while this context lasts."""

    functions = (
        (predictive, "predict"),
        (predictive, "round_prediction"),
        (predictive, "reconstruct"),
        (transform, "quantisation_steps"),
        (transform, "median_prediction"),
        (transform, "predict_dc"),
        (transform, "decode_end"),
        (transform, "decode_signs"),
    )

    def __enter__(self):
        self.decoders = []
        self.results = {name: [] for _, name in self.functions}
        self.originals = [getattr(module, name) for module, name in self.functions]
        for (module, name), original in zip(self.functions, self.originals):
            setattr(module, name, self.noting(name, original))
        planes.EntropyDecoder = payloads.EntropyDecoder = self.decoder
        return self

    def decoder(self, chunk):
        self.decoders.append(TracingDecoder(chunk))
        return self.decoders[-1]

    def noting(self, name, function):
        def noted(*arguments):
            self.results[name].append(function(*arguments))
            return self.results[name][-1]

        return noted

    def __exit__(self, *_):
        planes.EntropyDecoder = payloads.EntropyDecoder = EntropyDecoder
        for (module, name), original in zip(self.functions, self.originals):
            setattr(module, name, original)


def spelled(model):
    """Return the name of a model as words and numbers."""
    if model is None:
        return "literal"
    parts = []
    for part in model:
        if isinstance(part, tuple):  # the bits of a context, or the name of a set of models
            parts.append("".join(map(str, part)) if isinstance(part[0], int) else spelled(part))
        else:
            parts.append(str(part))
    return " ".join(parts)


def table(titles, rows, first=1):
    """Return a table of numbers; the first columns are aligned to the left."""
    rule = [":---"] * first + ["---:"] * (len(titles) - first)
    return "\n".join("| " + " | ".join(map(str, row)) + " |" for row in [titles, rule, *rows])


def decision_table(steps):
    titles = ["number", "model", "P", "count", "p", "state", "bit", "word", "state after"]
    return table(titles, [(number, *step) for number, step in enumerate(steps, 1)], first=2)


def traced_segment(codec, body, rows, columns):
    """Return (Tracing, symbols) of a segment of one channel."""
    plane = {"rows": rows, "columns": columns, "channels": 1}
    with Tracing() as tracing:
        _, symbols = planes.decode_segment(None, "xy", plane, 0, rows, Content(codec, rows * columns, body))
    return tracing, symbols


def predictive_example():
    """Return the tables of section 13.2."""
    tracing, symbols = traced_segment(PREDICTIVE, PREDICTIVE_EXAMPLE, 2, 3)
    names = "predict", "round_prediction", "reconstruct"
    rows = []
    for (y, x, _), predicted, here, symbol in zip(symbols, *(tracing.results[name] for name in names)):
        dev = abs(128 * symbol - predicted.prediction) >> 3
        residual = (symbol - here.rounded) * (-1 if here.remainder < 0 else 1)  # as it is coded
        numbers = here.rounded, here.remainder, here.context, residual, symbol, dev
        rows.append((f"({y}, {x})", *predicted, *numbers))
    titles = [
        "texel",
        "gradient",
        "prediction",
        "activity_class",
        "rounded",
        "remainder",
        "context",
        "signed",
        "symbol",
        "dev",
    ]
    return decision_table(tracing.decoders[0].steps), table(titles, rows)


def transform_example():
    """Return the tables of section 13.3."""
    tracing, symbols = traced_segment(TRANSFORM, TRANSFORM_EXAMPLE, 4, 8)
    rows = []
    names = "quantisation_steps", "median_prediction", "predict_dc", "decode_end", "decode_signs"
    for bx, results in enumerate(zip(*(tracing.results[name] for name in names))):
        qstep, expected_dc, dc_prediction, end, coefficient = results
        listed = [coefficient.get(at, 0) for at in ((0, 0), (0, 1), (1, 0))]
        rows.append((f"(0, {bx})", qstep[0, 0], qstep[0, 1], expected_dc, dc_prediction, end, *listed))
    titles = ["block", "qstep[0, 0]", "qstep[0, 1]", "from neighbours", "dc_prediction", "end"]
    titles += ["coefficient[0, 0]", "[0, 1]", "[1, 0]"]
    lines = [" ".join(f"{symbols[y, x, 0]:3}" for x in range(8)) for y in range(4)]
    return decision_table(tracing.decoders[0].steps), table(titles, rows), "\n".join(f"    {line}" for line in lines)


def main(arguments):
    if len(arguments) != 2:
        print("\n\n".join(predictive_example() + transform_example()))
        return
    with open(arguments[0], "rb") as file:
        data = file.read()
    stored = read_chunks(data, False)[0][int(arguments[1])].stored
    with Tracing() as tracing:
        decode(data)
    for decoder in tracing.decoders:
        if decoder.stored == stored:
            print(decision_table(decoder.steps))
            return
    print("this chunk has no coded data")


if __name__ == "__main__":
    main(sys.argv[1:])
