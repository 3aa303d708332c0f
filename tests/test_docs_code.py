"""The code on the pages of the docs runs, and says what the pages say."""

from pathlib import Path

import pytest
from page_code import compare, inside, page_names, run_page

ROOT = Path(__file__).parents[1]
QUICK = {"troubleshooting.md"}  # nothing is deformed
PAGES = [name for name in page_names(ROOT) if not name.startswith("reference/")]


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if name in QUICK else pytest.mark.slow) for name in PAGES]
)
@pytest.mark.filterwarnings("ignore:negative weights:UserWarning")  # own-mesh.md speaks of it
def test_the_code_of_a_page_says_what_the_page_says(name, tmp_path):
    with inside(tmp_path):
        run_page((ROOT / "docs" / name).read_text(encoding="utf-8"), name)


def test_a_page_that_is_wrong_is_found_out():
    page = "```python\nprint('height', 2.0)\n```\n\n```text\nheight 2.5\n```\n"
    with pytest.raises(AssertionError):
        run_page(page, "page")
    run_page(page.replace("2.5", "2.01"), "page")
    with pytest.raises(AssertionError):
        compare("width 2.0", "height 2.0", "page", 0.1)
    with pytest.raises(AssertionError, match="InputError"):
        run_page("```python\nimport jaxdeform as jd\njd.Mesh([], [])\n```\n", "page")
