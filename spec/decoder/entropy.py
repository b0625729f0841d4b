"""Section 5: the rANS entropy decoder, adaptive probability models and binarisations."""

import struct

from .common import require

EQUIPROBABLE = 2048  # a probability of one half, in 1/4096
UNTRAINED = (32768, 0)  # the initial (P, count) of a model unless a codec gives another one


def log_class(n):
    """Return the logarithmic class of n >= 0: two classes for each doubling."""
    length = n.bit_length()
    return n if length < 2 else 2 * length - 2 + (n >> length - 2 & 1)


class EntropyDecoder:
    def __init__(self, chunk):
        """Take the rANS state and all words that are left in the chunk."""
        (self.state,) = chunk.unpack("I")
        require(self.state >= 1 << 16, "the initial rANS state is below 65536")
        words = chunk.remaining()
        require(len(words) % 2 == 0, "the coded data ends within a word")
        self.words = list(struct.unpack(f"<{len(words) // 2}H", words))
        self.next_word = 0
        self.models = {}  # (P, count) by name

    def decision(self, p):
        """Decode a decision that is 1 with probability p / 4096."""
        low, high = self.state % 4096, self.state >> 12
        if low < p:
            bit, self.state = 1, p * high + low
        else:
            bit, self.state = 0, (4096 - p) * high + low - p
        if self.state < 1 << 16:
            require(self.next_word < len(self.words), "the coded data has too few words")
            self.state = self.state << 16 | self.words[self.next_word]
            self.next_word += 1
        return bit

    def adaptive(self, model, initial=UNTRAINED):
        """Decode a decision with the probability of the model of that name, and update the model."""
        P, count = self.models.get(model, initial)
        bit = self.decision(P >> 4)
        rate = 327680 // (5 * count + 8)
        P += (65536 - P) * rate >> 16 if bit else -(P * rate >> 16)
        self.models[model] = P, min(count + 1, 120)
        return bit

    def literal(self, length):
        """Decode a number of so many equiprobable bits, most significant first."""
        number = 0
        for _ in range(length):
            number = 2 * number + self.decision(EQUIPROBABLE)
        return number

    def positive(self, adaptive, unary, escape):
        """Decode an integer >= 1; adaptive(k) decodes a decision with model k of 0 .. unary + escape - 1."""
        for k in range(unary):
            if not adaptive(k):
                return k + 1
        length = 0
        while length < escape and adaptive(unary + length):
            length += 1
        return unary + 2**length + self.literal(length)

    def signed(self, context, unary, escape):
        """Decode an integer with the models of a context."""
        if not self.adaptive((context, "nonzero")):
            return 0
        if self.adaptive((context, "is_positive")):
            return self.positive(lambda k: self.adaptive((context, "above", k)), unary, escape)
        return -self.positive(lambda k: self.adaptive((context, "below", k)), unary, escape)

    def finish(self):
        require(self.next_word == len(self.words), "the coded data has too many words")
        require(self.state == 1 << 16, "the final rANS state is not 65536")
