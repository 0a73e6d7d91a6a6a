"""`python -m benchmarks precision`: one small harness per question, each printing one Markdown table."""

from __future__ import annotations

import sys

from benchmarks import acquisition, coverage, damage, precision

QUESTIONS = {
    "precision": precision.main,
    "damage": damage.main,
    "coverage": coverage.main,
    "acquisition": acquisition.main,
}


def main() -> int:
    question = QUESTIONS.get(sys.argv[1]) if len(sys.argv) > 1 else None
    if question is None:
        print(f"Say which benchmark: {', '.join(QUESTIONS)}.", file=sys.stderr)
        return 2
    return question(sys.argv[2:])


if __name__ == "__main__":
    sys.exit(main())
