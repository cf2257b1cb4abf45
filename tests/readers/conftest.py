"""The small CPHD file that tests of this folder change."""

from __future__ import annotations

import pytest


@pytest.fixture(scope="session")
def base(tmp_path_factory: pytest.TempPathFactory) -> object:
    cphd_files = pytest.importorskip("cphd_files", reason="the extra `formats` is not installed")
    return cphd_files.small_file(tmp_path_factory.mktemp("cphd"))
