"""`python -m benchmarks QUESTION`: one small harness per question, each printing Markdown tables.

The harness of a question is the module of that name in this folder; it is loaded only when it is asked.
"""

from __future__ import annotations

import sys
from importlib import import_module

QUESTIONS = ("acquisition", "coverage", "damage", "figures", "ghosts", "precision", "speed")


def main() -> int:
    question = sys.argv[1] if len(sys.argv) > 1 else ""
    if question not in QUESTIONS:
        print(f"Say which benchmark: {', '.join(QUESTIONS)}.", file=sys.stderr)
        return 2
    answer: int = import_module(f"benchmarks.{question}").main(sys.argv[2:])
    return answer


if __name__ == "__main__":
    sys.exit(main())
