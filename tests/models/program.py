"""Small solver for the tests of `ExecutableModel`: ``python program.py INPUT``. Uses the standard library only.

INPUT contains offset, slope, n, dt and the behaviour, one per line. The response is written to ``out.txt``.
"""

import os
import shutil
import subprocess
import sys
import time

offset, slope, n, dt, what = open(sys.argv[1]).read().split()
rows = [(k * float(dt), float(offset) + float(slope) * (k * float(dt))) for k in range(int(n))]
if what == "hang":
    time.sleep(3600)
if what in ("family", "leftovers"):  # a child, one that may be in its own session, and one whose parent has ended
    sleep = ["sleep", "3600"]
    children = [subprocess.Popen(sleep), subprocess.Popen(sleep, start_new_session=what == "family")]
    read, write = os.pipe()
    if os.fork() == 0:
        if pid := os.fork():
            os.write(write, str(pid).encode())
            os._exit(0)
        os.execve(shutil.which("sleep"), sleep, {})
    pids = [os.getpid(), *(child.pid for child in children), int(os.read(read, 20))]
    with open(os.environ["FAMILY"], "w") as file:
        file.write(" ".join(map(str, pids)))
    if what == "family":
        time.sleep(3600)
if what == "fail":
    sys.exit("matrix is singular\n  at step 12\n")
if what == "crash":
    os.abort()
if what == "flood":
    while True:
        print("all is well " * 1000, flush=True)
if what == "fill":
    with open("big.bin", "wb") as file:
        while True:
            file.write(bytes(2**16))
            file.flush()
if what == "silent":
    sys.exit(0)
if what == "nan":
    rows[3] = (rows[3][0], float("nan"))
if what == "empty":
    rows = []
if what == "short":
    rows = rows[:-1]
separator = ", " if what == "commas" else " "
with open("out.txt", "w") as file:
    file.write("# time and displacement\n")
    if what == "words":
        file.write("no convergence\n")
    for time_, value in rows:
        file.write(f"{time_!r}{separator}{value!r}\n" if what != "one" else f"{value!r}\n")
