"""Fuzz the decoders guided by coverage: `PYTHONPATH=tests python -m robot.links.fuzz_link_guided FOLDER -runs=1000000`.

Needs atheris (`pip install atheris`), which keeps streams that reach new lines in FOLDER and mutates them further; the
remaining arguments are libFuzzer's. Each stream is judged as in `fuzz_link.py`.
"""

import sys

import atheris

with atheris.instrument_imports(include=["finssim.robot.links"]):
    from robot.links import wire
    from robot.links.fuzz_link import SIDES, Fuzzer, judge

FUZZER = Fuzzer()


def mutate(data: bytes, size: int, seed: int) -> bytes:
    """Return a mutation by libFuzzer or one of frames, because random bytes hardly ever have a valid CRC."""
    FUZZER.random.seed(seed)
    if not data or FUZZER.random.random() < 0.3:
        return atheris.Mutate(data, size)
    side = SIDES[data[0] & 1]
    rest = FUZZER.random.choice(FUZZER.mutations)(data[1:], side)
    rest = FUZZER.random.choice((rest, wire.sealed(rest), rest + FUZZER.random.choice(FUZZER.seeds[side])))
    return (data[:1] + rest)[:size]


def judge_one(data: bytes) -> None:
    """Judge one stream; the first byte selects the decoder and the cut."""
    if data:
        judge(data[1:], SIDES[data[0] & 1], [data[0] % len(data)])


if __name__ == "__main__":
    atheris.Setup([*sys.argv, "-max_len=400", "-print_final_stats=1"], judge_one, custom_mutator=mutate)
    atheris.Fuzz()
