"""The example with Numba of docs/c-modules.md; not run by default, as Numba is 208 MB.

pip install numba==0.68.1
pytest tests/unit/cmodule/numba_law.py
"""

import re

from c_modules import ROOT

from pbonet.config import Library
from pbonet.testing import Bench


def test_a_law_in_numba_stands_in_a_module_in_python(tmp_path):
    page = (ROOT / "docs" / "c-modules.md").read_text()
    (code,) = re.findall(
        r"<!-- file: spring.py -->\n```python\n(.*?)```", page, re.DOTALL
    )
    (tmp_path / "spring.py").write_text(code)
    bench = Bench(Library([tmp_path]).load("spring").cls, {"q": [1, 2, 3, 4, 5, 6]})
    bench.on()
    bench.step()
    assert bench.outputs.tau.tolist() == [-2.0, -4.0, -6.0, -8.0, -10.0, -12.0]
    bench.inputs.q = [0, 0, 0, 0, 0, 1]
    bench.set("k", 3.0)
    bench.step()
    assert bench.outputs.tau.tolist() == [0.0, 0.0, 0.0, 0.0, 0.0, -3.0]
