"""Toys that do what no method should: to their process, to the coordinator's, and with words."""

from __future__ import annotations

import re

MISCHIEF = """
import os
import resource
import socket
import subprocess
import sys
import threading
import time

import numpy as np

from orthoflow.errors import MethodError
from orthoflow.sdk.context import StepContext
from toy_plugin.works import Numbers, Work, work

SLEEPER = [sys.executable, "-c", "import time; time.sleep(600)"]

def _pipe():
    # The progress pipe is the only one a step has.
    return next(n for n in range(3, 64) if _name(n).startswith("pipe:"))

def _name(number):
    # What watches the memory opens and closes files in a thread of its own meanwhile.
    try:
        return os.readlink(f"/proc/self/fd/{number}")
    except FileNotFoundError:
        return ""

def _say(content):
    pipe = _pipe()
    while content:
        content = content[os.write(pipe, content):]

@work("exact")
def daemon(values, params, ctx):
    return np.array([float(subprocess.Popen(SLEEPER, start_new_session=True).pid)])

@work("exact")
def daemon_then_crash(values, params, ctx):
    ctx.log(f"started {subprocess.Popen(SLEEPER, start_new_session=True).pid}")
    os.abort()

@work("exact")
def forks(values, params, ctx):
    if os.fork():
        time.sleep(0.2)
        return values + 1.0
    return values + 2.0

@work("exact")
def long_line(values, params, ctx):
    for _ in range(64):
        _say(b"x" * (1 << 20))
    return values

@work("exact")
def never_silent(values, params, ctx):
    line = b'{"kind":"log","text":"x","fraction":0}\\n' * 1000
    while True:
        _say(line)

@work("exact")
def prints_much(values, params, ctx):
    for _ in range(40):
        print("y" * (1 << 20))
    print("the end")
    return values

@work("exact")
def closes_all(values, params, ctx):
    os.closerange(0, 256)
    ctx.log("unheard")
    ctx.progress(0.5)
    return values

@work("exact")
def closes_streams(values, params, ctx):
    sys.stdout.close()
    sys.stderr = None
    ctx.log("unheard")
    return values

@work("exact")
def leaves_fifo(values, params, ctx):
    os.mkfifo(ctx.scratch.parent / "result.json")
    os._exit(0)

@work("exact")
def leaves_giant(values, params, ctx):
    with (ctx.scratch.parent / "result.json").open("wb") as file:
        file.truncate(1 << 40)
    os._exit(0)

@work("exact")
def leaves_brackets(values, params, ctx):
    (ctx.scratch.parent / "result.json").write_text("[" * 100_000)
    os._exit(0)

@work("exact")
def leaves_another(values, params, ctx):
    text = '{"format": "orthoflow/result/1", "status": "ok", "key": "another"}'
    (ctx.scratch.parent / "result.json").write_text(text)
    os._exit(0)

@work("exact")
def digs_deep(values, params, ctx):
    os.chdir(ctx.scratch)
    for _ in range(1500):
        os.mkdir("deeper")
        os.chdir("deeper")
    return values

@work("exact")
def replaces_log(values, params, ctx):
    log = os.readlink("/proc/self/fd/2")
    os.unlink(log)
    os.mkfifo(log)
    print("still heard")
    return values

@work("exact")
def stops(values, params, ctx):
    # Its keeper with it, which leaves nobody to obey.
    os.killpg(0, 19)

def _parent_of(number):
    with open(f"/proc/{number}/stat") as file:
        return int(file.read().rpartition(")")[2].split()[1])

@work("exact")
def kills_keeper(values, params, ctx):
    os.kill(os.getppid(), 9)
    time.sleep(600)

@work("exact")
def kills_server(values, params, ctx):
    os.kill(_parent_of(os.getppid()), 9)
    time.sleep(600)

@work("exact")
def stops_server(values, params, ctx):
    os.kill(_parent_of(os.getppid()), 19)
    return values

@work("exact")
def opens_nothing_more(values, params, ctx):
    resource.setrlimit(resource.RLIMIT_NOFILE, (0, 0))
    return values

@work("exact")
def writes_nothing_more(values, params, ctx):
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
    return values

@work("exact")
def floods_all_sockets(values, params, ctx):
    for number in range(3, 64):
        if _name(number).startswith("socket:"):
            with socket.socket(fileno=os.dup(number)) as one:
                one.setblocking(False)
                for content in [b"os sys numba", b"\\xff" * 5000, b""] * 1000:
                    try:
                        one.send(content)
                    except OSError:
                        pass
    return values

@work("exact")
def goes_on_writing(values, params, ctx):
    array = np.zeros(1 << 20)
    def write():
        while True:
            array[:] += 1.0
    threading.Thread(target=write, daemon=True).start()
    return array

class Speechless(Exception):
    def __str__(self):
        raise RuntimeError("no words")

@work("exact")
def raises_base(values, params, ctx):
    raise BaseException("of no kind")

@work("exact")
def raises_interrupt(values, params, ctx):
    raise KeyboardInterrupt

@work("exact")
def raises_speechless(values, params, ctx):
    raise Speechless

@work("exact")
def raises_nothing(values, params, ctx):
    raise MethodError

@work("exact")
def raises_lines(values, params, ctx):
    raise ValueError("one\\ntwo \\x1b[31m \\udcff \\0")

@work("exact")
def raises_much(values, params, ctx):
    raise ValueError("x" * (10 << 20))

@work("exact")
def warns_much(values, params, ctx):
    for index in range(1000):
        ctx.warn(f"{index}\\n\\x1b[31m\\udcff")
    ctx.warn("w" * (10 << 20))
    return values
"""

NAMES = re.findall(r"^def ([a-z]\w*)\(values", MISCHIEF, re.MULTILINE)
