#!/usr/bin/env python3
"""Noctule's compiled networks beside PyTorch, ONNX Runtime and OpenVINO, in one run.

    python3 -m venv venv && venv/bin/pip install numpy torch onnx onnxscript onnxruntime openvino
    cargo build --release
    venv/bin/python benches/peers.py --peers PEERS.py [--config xs,s,full] [--json]

PEERS.py is the program that gives the vendor engines the same network in their best formulation;
`PEERS.py --config WIDTHS.json --engines E --precisions fp32,bf16 --threads 1,2 --json` must print
{"rows": [{"engine", "precision", "threads", "seconds_median", ...}]}. It gets the widths from
`noctule weights --describe --json`.

Ours runs before, between and after the engines, so that a machine that is not quiet slows both; the
median of its medians counts. The last column is the fastest engine's time over ours.
"""
import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile

ENGINES = ("eager", "inductor", "ort", "openvino")
THEIR_NAME = {"f32": "fp32", "bf16": "bf16"}


def ours(noctule, config, threads, precisions, rounds):
    """{(precision, threads): row} of one `noctule bench infer`."""
    command = [noctule, "bench", "infer", "--json", "--no-reference", "--config", config,
               "--threads", ",".join(map(str, threads)), "--precision", ",".join(precisions),
               "--rounds", str(rounds)]
    bench = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    return bench, {(row["precision"], row["threads"]): row for row in bench["rows"]}


def widths(noctule, config, folder):
    """Path of a file with the widths of `config`, and its multiply-adds."""
    command = [noctule, "weights", "--describe", "--json"]
    family = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    member = next(m for m in family if m["config"]["name"] == config)
    path = os.path.join(folder, f"{config}.json")
    with open(path, "w") as file:
        json.dump(member["config"], file)
    return path, member["gmac"]


def theirs(arguments, engine, path, threads, precisions):
    """{(precision, threads): seconds or None} of one engine."""
    command = [sys.executable, arguments.peers, "--config", path, "--engines", engine, "--json",
               "--precisions", ",".join(THEIR_NAME[p] for p in precisions),
               "--threads", ",".join(map(str, threads)), "--reps", str(arguments.rounds)]
    done = subprocess.run(command, capture_output=True, text=True)
    rows = json.loads(done.stdout)["rows"] if done.returncode == 0 else []
    mine = {theirs_: ours_ for ours_, theirs_ in THEIR_NAME.items()}
    return {(mine[row["precision"]], row["threads"]): row.get("seconds_median") for row in rows}


def race(arguments, config, folder):
    """One row per precision and number of threads."""
    path, gmac = widths(arguments.noctule, config, folder)
    threads = [int(t) for t in arguments.threads.split(",")]
    precisions = arguments.precision.split(",")
    keys = [(p, t) for p in precisions for t in threads]
    mine, engines, peaks = {key: [] for key in keys}, {}, []

    def lap():
        bench, rows = ours(arguments.noctule, config, threads, precisions, arguments.rounds)
        peaks.append((bench["peak_gflops_f32"], bench["peak_gflops_bf16"]))
        for key in keys:
            mine[key].append(rows[key]["seconds_median"])

    lap()
    for engine in arguments.engines.split(","):
        print(f"{config}: {engine}", file=sys.stderr, flush=True)
        engines[engine] = theirs(arguments, engine, path, threads, precisions)
        lap()
    peak = {"f32": max(p[0] for p in peaks), "bf16": max(p[1] for p in peaks)}
    rows = []
    for key in keys:
        precision, count = key
        seconds = statistics.median(mine[key])
        others = {e: times[key] for e, times in engines.items() if times.get(key)}
        best = min(others, key=others.get) if others else None
        rows.append({
            "config": config, "precision": precision, "threads": count,
            "seconds": seconds, "seconds_min": min(mine[key]),
            "share_of_peak": 2 * gmac / seconds / (count * peak[precision]),
            "engines": others, "fastest_engine": best,
            "ratio": others[best] / seconds if best else None,
        })
    return {"peak_gflops": peak, "rows": rows}


def show(result):
    peak = result["peak_gflops"]
    print(f"peak per core {peak['f32']:.0f} GFLOP/s f32, {peak['bf16']:.0f} bf16")
    print("config prec threads    ours ms  of peak   " +
          "".join(f"{engine:>12}" for engine in ENGINES) + "   fastest/ours")
    for row in result["rows"]:
        cells = "".join(f"{1e3 * row['engines'][e]:>12.1f}" if e in row["engines"] else f"{'-':>12}"
                        for e in ENGINES)
        ratio = f"{row['ratio']:.2f}" if row["ratio"] else "-"
        print(f"{row['config']:6} {row['precision']:4} {row['threads']:7} "
              f"{1e3 * row['seconds']:10.1f} {100 * row['share_of_peak']:7.1f}%   {cells}   {ratio}")


def main():
    here = os.path.dirname(os.path.abspath(__file__))
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--peers", required=True, help="the program that runs the vendor engines")
    parser.add_argument("--noctule", default=os.path.join(here, "..", "target", "release", "noctule"))
    parser.add_argument("--config", default="xs,s", help="members of the family")
    parser.add_argument("--engines", default=",".join(ENGINES))
    parser.add_argument("--precision", default="f32,bf16")
    parser.add_argument("--threads", default="1,2")
    parser.add_argument("--rounds", type=int, default=7, help="timed runs per row and lap")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        results = [race(arguments, config, folder) for config in arguments.config.split(",")]
    if arguments.json:
        print(json.dumps(results, indent=1))
    else:
        for result in results:
            show(result)


if __name__ == "__main__":
    main()
