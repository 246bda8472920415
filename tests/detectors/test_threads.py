import os

import cv2

from kpbench.workers import run_jobs


def threads_of_worker(job, progress):
    return cv2.getNumThreads(), int(os.environ["OMP_NUM_THREADS"])


def test_worker_processes_share_the_cores(monkeypatch):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setattr("kpbench.workers.count_cores", lambda: 6)
    found = list(run_jobs(threads_of_worker, [0, 1], 2, lambda images: None, share_cores=True))
    assert found == [(3, 3), (3, 3)]


def test_one_worker_uses_all_cores(monkeypatch):
    monkeypatch.setattr("kpbench.workers.count_cores", lambda: 3)
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    before = cv2.getNumThreads()
    assert list(run_jobs(threads_of_worker, [0], 1, lambda images: None, share_cores=True)) == [(3, 1)]
    assert cv2.getNumThreads() == before
