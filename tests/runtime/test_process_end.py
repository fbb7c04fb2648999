"""A process that ends while a thread computes."""

import subprocess
import sys

PROGRAM = """
import sys, threading, torch
from splatgraft.runtime.process import end_process

begun = threading.Event()

def compute():
    while True:
        a = torch.rand(300, 300, requires_grad=True)
        torch.linalg.svd((a @ a).detach())
        begun.set()

threading.Thread(target=compute, daemon=True).start()
begun.wait()
sys.stdout.write("the last words")
end_process(3)
"""


def test_a_process_ends_with_its_status_while_a_thread_is_in_torch() -> None:
    ended = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=False)
    assert ended.returncode == 3, ended.stderr
    assert ended.stdout == "the last words"
    assert ended.stderr == ""
