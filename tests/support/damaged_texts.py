"""Randomly damaged texts, which readers must accept or refuse in one line."""

import json
from copy import deepcopy

WORDS = (
    "nan", "inf", "-inf", "-0", "1e400", "1" + "0" * 400, "9" * 5000, "1_0", "0x10",
    "1e308", "-1e308", "5e-324", "true", "[]", "{}", '""', "null", "[" * 3000,
    "{" * 3000, "{a=" * 1500, "a." * 3000, "\x00", "\x7f", "\ufeff", "\ud800",
    "\\ud800", "\u202e", "\u0661", "\u00b2", "'", '"', '"""', "#", "=", ",", "\n",
    "\r", "/", "..", ":", "x" * 3000, "10" * 10, "-1", "2.5", "1979-05-27", "07:32:00",
    "%s", "{0}", " ",
)  # fmt: skip
VALUES = (
    None, True, False, 0, -1, 1, 10**18, 2**63, 10**30, 10**400, 0.0, -0.0, 1e-320,
    1e308, -1e308, 0.5, "", "x" * 3000, "\x00", "\u202e", "nan", "1", [], [[]], {},
    {"": {}}, [None] * 50, {"a": [1e308, -5, "b", {"c": 10**25}]}, ["a"],
    [1e308, 1e308],
)  # fmt: skip


def damaged(text, random):
    """Return a text after random deletions, repetitions, replacements or insertions."""
    for _ in range(random.choice((1, 1, 1, 2, 4))):
        i, j = sorted(random.randrange(len(text) + 1) for _ in range(2))
        j = min(j, i + random.choice((1, 3, 30)))
        match random.randrange(5):
            case 0:
                text = text[:i] + text[j:]
            case 1:
                text = text[:j] + text[i:]
            case 2:
                text = text[:i] + random.choice(WORDS) + text[j:]
            case 3:
                text = text[:i] + random.choice(WORDS) + text[i:]
            case _:
                text = text[:i] + chr(random.randrange(1, 0x250)) + text[j:]
    return text


def distorted(data, random):
    """Return a copy of nested plain data with up to five values replaced."""
    data = json.loads(json.dumps(data))
    for _ in range(random.choice((1, 1, 2, 5))):
        at = data
        while True:
            keys = list(at) if isinstance(at, dict) else list(range(len(at)))
            if not keys:
                break
            key = random.choice(keys)
            if isinstance(at[key], dict | list) and at[key] and random.random() < 0.7:
                at = at[key]
                continue
            at[key] = deepcopy(random.choice(VALUES))
            break
    return data
