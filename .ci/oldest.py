"""Prints constraints for pip: the oldest version of each dependency that pyproject.toml allows.

python3.11 .ci/oldest.py test >constraints.txt
pip install '.[test]' --constraint constraints.txt
"""

import re
import sys
import tomllib
from pathlib import Path


def oldest(requirements, extras):
    """`name==version` of each requirement with a lower bound, also in the extras it names."""
    for requirement in requirements:
        if own := re.match(r"jaxchain\[(.*)\]", requirement):
            for extra in own[1].split(","):
                yield from oldest(extras[extra], extras)
        elif bound := re.match(r"([\w.-]+)(?:\[.*\])?>=([\w.]+)", requirement):
            yield f"{bound[1]}=={bound[2]}"


project = tomllib.loads(Path("pyproject.toml").read_text(encoding="utf-8"))["project"]
extras = project["optional-dependencies"]
chosen = [f"jaxchain[{','.join(sys.argv[1:])}]"] if sys.argv[1:] else []
print("\n".join(oldest([*project["dependencies"], *chosen], extras)))
