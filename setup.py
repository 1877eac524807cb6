"""What setup.cfg cannot say: kernels in the package, README and addresses on its page."""

import os
import re
import tempfile
from configparser import ConfigParser
from glob import glob
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py


class BuildWithKernels(build_py):
    """Modules and kernels. An editable install has both from the clone."""

    def run(self):
        """Copy them."""
        super().run()
        if not self.editable_mode:
            self.mkpath(f"{self.build_lib}/lnocl/kernels")
            for file in glob("kernels/*.cl"):
                self.copy_file(file, f"{self.build_lib}/lnocl/kernels")


def read_description() -> str:
    """Return README without its picture and with the words of links to files of the repository."""
    text = Path("README.md").read_text(encoding="utf-8")
    text = re.sub(r"!\[.*\]\(.*\)\n\n", "", text)
    return re.sub(r"\[([^]]*)\]\((?!https?:)[^)]*\)", r"\1", text)


def read_addresses() -> dict[str, str]:
    """Return the addresses that follow from that of the repository."""
    setup_cfg = ConfigParser()
    setup_cfg.read("setup.cfg", encoding="utf-8")
    repository = setup_cfg["metadata"]["url"]
    return {
        "Documentation": f"{repository}/tree/main/docs",
        "Changelog": f"{repository}/blob/main/CHANGELOG.md",
        "Issues": f"{repository}/issues",
    }


with tempfile.TemporaryDirectory() as folder:
    # A clone that cannot be written to is built elsewhere.
    elsewhere = {"egg_info": {"egg_base": folder}, "build": {"build_base": folder}}
    setup(
        cmdclass={"build_py": BuildWithKernels},
        long_description=read_description(),
        project_urls=read_addresses(),
        options={} if os.access(".", os.W_OK) else elsewhere,
    )
