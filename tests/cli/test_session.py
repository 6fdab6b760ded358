"""The compilation cache of the command line."""

import sys
from pathlib import Path


def test_compilations_are_kept_in_the_users_cache_folder(monkeypatch, tmp_path):
    import jax

    from jaxloc.cli import session

    kept = jax.config.jax_compilation_cache_dir, jax.config.jax_persistent_cache_min_compile_time_secs
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(sys, "platform", "linux")
    try:
        jax.config.update("jax_compilation_cache_dir", None)
        session.keep_compilations()
        assert Path(jax.config.jax_compilation_cache_dir) == tmp_path / "jaxloc" / "compiled"
        jax.config.update("jax_compilation_cache_dir", "elsewhere")
        session.keep_compilations()
        assert jax.config.jax_compilation_cache_dir == "elsewhere"
    finally:
        jax.config.update("jax_compilation_cache_dir", kept[0])
        jax.config.update("jax_persistent_cache_min_compile_time_secs", kept[1])
