"""Toys that do what no method should: to their process, to the coordinator's, and with words."""

from __future__ import annotations

import re

MISCHIEF = """
import os
import subprocess
import sys
import threading
import time

import numpy as np

from orthoflow.errors import MethodError
from orthoflow.sdk.context import StepContext
from toy_plugin.works import Numbers, Work, work


# The process that starts it is gone before the step is.
HIDING = (
    "import subprocess, sys; p = subprocess.Popen([sys.executable, '-c', "
    "'import time; time.sleep(600)'], start_new_session=True, stdout=subprocess.DEVNULL); "
    "print(p.pid)"
)


def hidden():
    asked = subprocess.run([sys.executable, "-c", HIDING], stdout=subprocess.PIPE, check=True)
    return int(asked.stdout)


@work("exact")
def hides(values, params, ctx):
    ctx.log(f"hidden {hidden()}")
    return values


@work("exact")
def forks(values, params, ctx):
    if os.fork():
        time.sleep(0.2)
        return values + 1.0
    return values + 2.0


@work("exact")
def never_silent(values, params, ctx):
    while True:
        ctx.log("x" * 100)

@work("exact")
def prints_much(values, params, ctx):
    for _ in range(40):
        print("y" * (1 << 20))
    print("the end")
    return values


@work("exact")
def closes_streams(values, params, ctx):
    sys.stdout.close()
    sys.stderr = None
    ctx.log("unheard")
    return values


@work("exact")
def stops(values, params, ctx):
    os.killpg(0, 19)


@work("exact")
def kills_server(values, params, ctx):
    os.kill(os.getppid(), 9)
    time.sleep(600)


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
