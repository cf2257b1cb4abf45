"""The rules of the extensions of STAC that items use, as schemas for pystac, which would fetch them from the network.

Each states the fields of an extension in the version that items name, with their types, and forbids others with its
prefix. The rules of items themselves come with pystac.
"""

from __future__ import annotations

from typing import Any

ABOVE_ZERO = {"type": "number", "exclusiveMinimum": 0}
WHOLE = {"type": "integer", "minimum": 1}
TEXT = {"type": "string", "minLength": 1}


def numbers(*counts: int) -> dict[str, Any]:
    return {"type": "array", "items": {"type": "number"}, "anyOf": [{"minItems": n, "maxItems": n} for n in counts]}


FIELDS: dict[str, tuple[str, str, dict[str, Any]]] = {
    "xarray-assets": ("v1.0.0", "xarray", {"open_kwargs": {"type": "object"}, "storage_options": {"type": "object"}}),
    "sar": ("v1.3.2", "sar", {
        "instrument_mode": TEXT, "frequency_band": {"enum": ["P", "L", "S", "C", "X", "Ku", "K", "Ka"]},
        "center_frequency": ABOVE_ZERO, "bandwidth": ABOVE_ZERO,
        "polarizations": {
            "type": "array", "minItems": 1, "uniqueItems": True,
            "items": {"enum": ["HH", "VV", "HV", "VH", "LH", "LV", "RH", "RV", "CH", "CV"]},
        },
        "product_type": TEXT, "resolution_range": ABOVE_ZERO, "resolution_azimuth": ABOVE_ZERO,
        "pixel_spacing_range": ABOVE_ZERO, "pixel_spacing_azimuth": ABOVE_ZERO, "looks_range": WHOLE,
        "looks_azimuth": WHOLE, "looks_equivalent_number": ABOVE_ZERO,
        "observation_direction": {"enum": ["left", "right"]},
    }),
    "projection": ("v2.0.0", "proj", {
        "code": {"type": ["string", "null"], "pattern": "^[A-Za-z0-9_]+:[A-Za-z0-9_.]+$"}, "wkt2": TEXT,
        "shape": {"type": "array", "items": WHOLE, "minItems": 2, "maxItems": 2}, "transform": numbers(6, 9),
        "bbox": numbers(4, 6),
    }),
    "processing": ("v1.1.0", "processing", {
        "level": {"type": "string", "pattern": "^(RAW|L[0-4][A-C]?)$"}, "lineage": TEXT,
        "software": {"type": "object", "minProperties": 1, "additionalProperties": TEXT},
    }),
    "sat": ("v1.0.0", "sat", {"orbit_state": {"enum": ["ascending", "descending", "geostationary"]}}),
}  # fmt: skip


def schemas() -> dict[str, dict[str, Any]]:
    """The schema of each extension by its address."""
    made = {}
    for name, (version, prefix, fields) in FIELDS.items():
        address = f"https://stac-extensions.github.io/{name}/{version}/schema.json"
        known = {
            "type": "object", "properties": {f"{prefix}:{field}": rule for field, rule in fields.items()},
            "patternProperties": {f"^(?!{prefix}:)": {}}, "additionalProperties": False,
        }  # fmt: skip
        made[address] = {
            "$schema": "http://json-schema.org/draft-07/schema#", "$id": address, "type": "object",
            "properties": {
                "properties": known, "assets": {"type": "object", "additionalProperties": known},
                "stac_extensions": {"type": "array", "contains": {"const": address}},
            },
            "required": ["stac_extensions", "properties", "assets"],
        }  # fmt: skip
    return made
