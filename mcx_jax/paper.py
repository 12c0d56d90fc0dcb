"""The paper's published results (table 3), for comparison."""

import csv
import functools

from mcx_jax.assets import asset_path


@functools.cache
def table3() -> dict[tuple[str, str], dict[str, float]]:
    """(delay, sea) -> columns of assets/paper_table3.csv as numbers."""
    lines = asset_path("paper_table3.csv").read_text().splitlines()
    rows = csv.DictReader(line for line in lines if not line.startswith("#"))
    return {
        (row["delay"], row["sea"]): {
            name: float(value) for name, value in row.items() if name not in ("delay", "sea")
        }
        for row in rows
    }
