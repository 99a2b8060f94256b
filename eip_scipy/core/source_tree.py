"""Finds `eip_scipy.integrations` in a source tree.

An installed package has the folder inside. In a clone it lies beside the package, and Python, started there, finds this
package first, whatever is installed.
"""

import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

_HERE = Path(__file__).parents[1]
_FILE = _HERE.parent / "integrations" / "__init__.py"

if not (_HERE / "integrations").exists() and _FILE.is_file():
    _spec = spec_from_file_location("eip_scipy.integrations", _FILE, submodule_search_locations=[str(_FILE.parent)])
    assert _spec is not None
    assert _spec.loader is not None
    _module = sys.modules[_spec.name] = module_from_spec(_spec)
    _spec.loader.exec_module(_module)
    sys.modules["eip_scipy"].integrations = _module  # type: ignore[attr-defined]
