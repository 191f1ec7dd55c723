"""The page of results: an index.html that a browser opens from disk, without a server and without network.

It holds tables, plots and what is known of each case; the volumes and the X-rays of a case lie beside its NIfTI files
and are loaded when it is opened. The viewer is drawn on canvases and needs no WebGL: NiiVue lies on PyPI inside of
other programs alone, Jupyter widgets (ipyniivue 2.4) and applications (jupyterlab-niivue 0.2, niivue-streamlit 0.3),
none of which exports its viewer.
"""

from phydict.page.case_files import CASE_FILES, write_case_files
from phydict.page.document import PAGE, Contents, PageCase, check_own_page, write_page

__all__ = ["CASE_FILES", "PAGE", "Contents", "PageCase", "check_own_page", "write_case_files", "write_page"]
