"""Compiled programs are kept for the next process, unless the user or the disk says otherwise."""

import os
import subprocess
import sys

import pytest

from jaxshape import process
from jaxshape.process import bound_folder, compile_quickly, keep_compiled, processor

FOLDER, SMALLEST = "JAX_COMPILATION_CACHE_DIR", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"


@pytest.fixture
def environment(monkeypatch, tmp_path):
    """What the process sees of its environment: nothing of ours, and a cache of its own."""
    ours = {name: x for name, x in os.environ.items() if name not in (FOLDER, SMALLEST)}
    ours["XDG_CACHE_HOME"] = str(tmp_path)
    monkeypatch.setattr(os, "environ", ours)
    return ours


PROGRAM = """
from jaxshape.process import keep_compiled
keep_compiled()
import jax
hits = []
jax.monitoring.register_event_listener(lambda name, **_: hits.append(name.endswith("cache_hits")))
jax.jit(lambda x: x + 1)(1.0).block_until_ready()
print(sum(hits))
"""


def test_the_second_process_finds_what_the_first_compiled(environment, tmp_path):
    def hits(**settings):
        command = [sys.executable, "-c", PROGRAM]
        answer = subprocess.run(
            command, env=environment | settings, capture_output=True, text=True, check=True
        )
        assert "warning" not in answer.stderr.lower(), answer.stderr
        return int(answer.stdout)

    assert hits(JAX_ENABLE_COMPILATION_CACHE="false") == 0
    assert not list(tmp_path.glob("jaxshape/compiled/*"))
    assert hits() == 0
    assert hits() > 0
    assert (tmp_path / "jaxshape/compiled").stat().st_mode & 0o077 == 0


def test_this_jax_knows_the_flags_with_which_it_compiles_quickly(environment):
    """An unknown flag would end the process."""
    environment.pop("XLA_FLAGS", None)
    program = """
from jaxshape.process import compile_quickly
compile_quickly()
import jax
print(jax.jit(lambda x: x + 1)(1.0))
"""
    command = [sys.executable, "-c", program]
    answer = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert answer.stdout == "2.0\n"


def test_flags_of_the_user_are_kept(environment):
    environment["XLA_FLAGS"] = "--xla_force_host_platform_device_count=4"
    compile_quickly()
    assert environment["XLA_FLAGS"] == "--xla_force_host_platform_device_count=4"


def test_the_folder_of_compiled_programs_is_bounded(tmp_path):
    """Those used longest ago go first; folders stay."""
    (tmp_path / "folder").mkdir()
    for age in range(8):
        (tmp_path / str(age)).write_bytes(bytes(100))
        os.utime(tmp_path / str(age), (10**9 - age, 10**9 - age))
    bound_folder(tmp_path, 800)
    assert len(list(tmp_path.iterdir())) == 9
    bound_folder(tmp_path, 799)
    assert sorted(os.listdir(tmp_path)) == ["0", "1", "2", "3", "4", "folder"]
    bound_folder(tmp_path / "nowhere", 1)


def test_the_folder_of_the_user_wins(environment, tmp_path):
    environment[FOLDER] = "elsewhere"
    keep_compiled()
    assert environment[FOLDER] == "elsewhere" and SMALLEST not in environment
    assert not list(tmp_path.iterdir())


def test_a_cache_that_cannot_be_written_is_not_used(environment, tmp_path):
    (tmp_path / "file").write_text("")
    environment["XDG_CACHE_HOME"] = str(tmp_path / "file")
    keep_compiled()
    assert FOLDER not in environment


def test_without_its_own_variable_the_cache_lies_in_the_home(environment, tmp_path):
    del environment["XDG_CACHE_HOME"]
    environment["HOME"] = str(tmp_path)
    keep_compiled()
    assert environment[FOLDER] == str(tmp_path / ".cache" / "jaxshape" / "compiled")


CPUINFO = """processor\t: 0
model name\t: A processor @ 2.1GHz: fast
flags\t\t: fpu avx2 amx_bf16

processor\t: 1
model name\t: Another
flags\t\t: fpu
"""


@pytest.fixture
def cpuinfo(tmp_path, monkeypatch):
    """Where the system tells of its processor, in place of /proc/cpuinfo."""
    path = tmp_path / "cpuinfo"
    monkeypatch.setattr(process, "Path", lambda name: path)
    processor.cache_clear()
    yield path
    processor.cache_clear()


def test_the_processor_is_the_first_that_the_system_tells_of(cpuinfo):
    cpuinfo.write_text(CPUINFO)
    name, features = processor()
    assert name == "A processor @ 2.1GHz: fast" and features == {"fpu", "avx2", "amx_bf16"}


def test_where_the_system_tells_nothing_the_processor_has_a_name_and_no_features(cpuinfo):
    name, features = processor()
    assert name and features == set()


@pytest.mark.parametrize("batch, cores, devices", [(32, 2, 2), (32, 6, 4), (7, 4, 1), (6, 16, 6)])
def test_training_counts_cores_that_divide_a_batch(monkeypatch, batch, cores, devices):
    monkeypatch.setattr(sys, "modules", {})
    monkeypatch.setattr(os, "cpu_count", lambda: cores)
    monkeypatch.delenv("JAX_NUM_CPU_DEVICES", raising=False)
    process.spread_over_cores(batch)
    assert os.environ["JAX_NUM_CPU_DEVICES"] == str(devices)
    monkeypatch.setenv("JAX_NUM_CPU_DEVICES", "1")
    process.spread_over_cores(batch)
    assert os.environ["JAX_NUM_CPU_DEVICES"] == "1"


def test_once_jax_is_there_nothing_is_set(monkeypatch):
    monkeypatch.delenv("JAX_NUM_CPU_DEVICES", raising=False)
    process.spread_over_cores(32)
    assert "JAX_NUM_CPU_DEVICES" not in os.environ


def test_the_settings_of_a_process_are_made_without_jax():
    code = "import sys, jaxshape.process; sys.exit('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
