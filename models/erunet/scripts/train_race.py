#!/usr/bin/env python3
"""Races a training step against PyTorch, taking turns step by step in one run.

    python train_race.py --model DIR/erunet_torch.py --ours TARGET/release/examples/train_pace

The model file has to offer `build(name, T=...)`, `set_stage(net, stage)` and
`loss_rdu(depth, truth, sparse)`. Prints the median milliseconds of both and their ratio,
and the same of CPU time, which other programs on the machine disturb less.
"""
import argparse
import importlib.util
import os
import statistics
import subprocess
import sys
import time

import torch


def load(path):
    spec = importlib.util.spec_from_file_location("model", path)
    module = importlib.util.module_from_spec(spec)
    sys.modules["model"] = module
    spec.loader.exec_module(module)
    return module


def cpu_seconds(pid):
    """User and system time a process has taken, all threads."""
    with open(f"/proc/{pid}/stat") as f:
        fields = f.read().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


class Theirs:
    def __init__(self, model, a):
        torch.manual_seed(0)
        self.model, self.stage = model, a.stage
        self.net = model.build(a.member, T=a.steps)
        model.set_stage(self.net, a.stage)
        wanted = [p for p in self.net.parameters() if p.requires_grad]
        self.adam = torch.optim.Adam(wanted, lr=1e-5, fused=a.fused or None)
        shape = lambda c: (a.batch, a.steps, c, a.side, a.side)
        self.blur = torch.rand(a.batch, 3, a.side, a.side)
        self.voxel = torch.rand(shape(5)) * 2 - 1
        self.truth = torch.rand(shape(1)) * 79 + 1
        self.sparse = self.truth * (torch.rand(shape(1)) < 0.03)

    def step(self):
        started = time.perf_counter()
        self.adam.zero_grad()
        depth, _ = self.net(self.blur, self.voxel, self.sparse)
        loss, _ = self.model.loss_rdu(depth, self.truth, self.sparse)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.adam.param_groups[0]["params"], 1.0)
        self.adam.step()
        float(loss.detach())
        return 1e3 * (time.perf_counter() - started)


class Ours:
    def __init__(self, a):
        names = ("member", "stage", "batch", "side", "steps", "threads")
        args = [x for n in names for x in (f"--{n}", str(getattr(a, n)))]
        # Candle's own threads spin while they wait, and its operations here are small.
        env = dict(os.environ, RAYON_NUM_THREADS=str(a.threads), CANDLE_NUM_THREADS="1")
        pipe = subprocess.PIPE
        command = [a.ours, "--serve", *args]
        self.process = subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, env=env)

    def step(self):
        self.process.stdin.write("\n")
        self.process.stdin.flush()
        return float(self.process.stdout.readline())


def main():
    p = argparse.ArgumentParser()
    p.add_argument("--model", required=True)
    p.add_argument("--ours", required=True)
    p.add_argument("--member", default="xs")
    p.add_argument("--stage", type=int, default=3)
    p.add_argument("--batch", type=int, default=2)
    p.add_argument("--side", type=int, default=128)
    p.add_argument("--steps", type=int, default=4)
    p.add_argument("--threads", type=int, default=1)
    p.add_argument("--rounds", type=int, default=9)
    p.add_argument("--fused", action="store_true", help="PyTorch's fused Adam")
    a = p.parse_args()
    torch.set_num_threads(a.threads)
    theirs, ours = Theirs(load(a.model), a), Ours(a)
    for _ in range(2):
        theirs.step(), ours.step()
    pids = (os.getpid(), ours.process.pid)
    before = [cpu_seconds(pid) for pid in pids]
    pairs = [(theirs.step(), ours.step()) for _ in range(a.rounds)]
    cpu = [1e3 * (cpu_seconds(pid) - t) / a.rounds for pid, t in zip(pids, before)]
    t, o = (statistics.median(x) for x in zip(*pairs))
    least = [min(x) for x in zip(*pairs)]
    print(
        f"{a.member} stage {a.stage}, {a.threads} threads: PyTorch {t:.1f} ms (least {least[0]:.1f}), "
        f"ours {o:.1f} ms (least {least[1]:.1f}), PyTorch / ours {t / o:.2f}; "
        f"CPU time {cpu[0]:.0f} and {cpu[1]:.0f} ms, ratio {cpu[0] / cpu[1]:.2f}"
    )
    ours.process.stdin.close()
    os.waitpid(ours.process.pid, 0)


if __name__ == "__main__":
    main()
