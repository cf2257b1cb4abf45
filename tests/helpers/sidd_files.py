"""Reader and checker of SIDD files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import sarkit.sidd as sksidd
import sarkit.verification as skver


@dataclass(frozen=True)
class Sidd:
    tree: Any
    pixels: Any
    checked: Any

    def load(self, path: str) -> Any:
        return sksidd.XmlHelper(self.tree).load("/".join(f"{{*}}{part}" for part in path.split("/")))

    def text(self, path: str) -> str:
        return str(self.tree.findtext("/".join(f"{{*}}{part}" for part in path.split("/"))))

    def row_and_column(self, ecef: Any) -> Any:
        return sksidd.ecef_to_pixel(self.tree, ecef)


def read_sidd(path: Path) -> Sidd:
    with open(path, "rb") as file:
        checked = skver.SiddConsistency.from_file(file)
        checked.check()
        file.seek(0)
        with sksidd.NitfReader(file) as reader:
            return Sidd(reader.metadata.images[0].xmltree, reader.read_image(0), checked)
