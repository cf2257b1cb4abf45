"""Reader and checker of SICD files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import sarkit.sicd as sksicd
import sarkit.verification as skver

# Reading and checking


@dataclass(frozen=True)
class Sicd:
    tree: Any
    pixels: Any
    checked: Any

    def load(self, path: str) -> Any:
        return sksicd.XmlHelper(self.tree).load("/".join(f"{{*}}{part}" for part in path.split("/")))


def errors(checked: Any) -> list[Any]:
    """Return failed checks of severity Error; warnings occur for pixels over 2.2 times as close as the band needs."""
    details = [detail for failure in checked.failures().values() for detail in failure["details"]]
    assert {detail["severity"] for detail in details} <= {"Error", "Warning"}
    return [detail for detail in details if detail["severity"] == "Error" and not detail["passed"]]


def read_sicd(path: Path) -> Sicd:
    with open(path, "rb") as file:
        checked = skver.SicdConsistency.from_file(file)
        checked.check()
        file.seek(0)
        with sksicd.NitfReader(file) as reader:
            return Sicd(reader.metadata.xmltree, reader.read_image().astype(np.complex64), checked)
