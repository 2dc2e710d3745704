"""``ssrvlad bench``."""

from ..options import Json, option


def bench(
    *,
    repetitions: int = option("Number of times to run each implementation.", default=5, min=1),
    as_json: Json = False,
) -> None:
    """Time the method on one thread of this machine: reference, torch, native core, ONNX Runtime.

    Example: ssrvlad bench --repetitions 3
    """
    from rich.table import Table

    from ..bench import bench_this_machine
    from ..output import print_json, print_table

    rows = bench_this_machine(repetitions)
    if as_json:
        print_json({"rows": rows})
        return
    table = Table("preset", "batch", "implementation", "ms an image", "min", "max", "times faster")
    for row in rows:
        times = [f"{row[key]:.2f}" for key in ("median_ms", "min_ms", "max_ms")]
        ratio = f"{row['times_faster']:.1f}" if "times_faster" in row else ""
        table.add_row(row["preset"], str(row["batch"]), row["way"], *times, ratio)
    print_table(table)
