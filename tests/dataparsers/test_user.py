"""A user whose id has no name, as in many containers."""

from __future__ import annotations

import getpass
import os
import pwd

import pytest

from dataparsers.user import name_the_user

VARIABLES = ("LOGNAME", "USER", "LNAME", "USERNAME")


def test_a_user_without_a_name_gets_that_of_later_versions_of_torch(monkeypatch):
    for name in VARIABLES:
        monkeypatch.setenv(name, "")
    nameless = next(uid for uid in range(54_321, 60_000) if uid not in {entry.pw_uid for entry in pwd.getpwall()})
    monkeypatch.setattr(os, "getuid", lambda: nameless)
    with pytest.raises((KeyError, OSError)):
        getpass.getuser()
    name_the_user()
    assert getpass.getuser() == f"uid_{nameless}"


def test_a_user_with_a_name_keeps_it(monkeypatch):
    for name in VARIABLES:
        monkeypatch.setenv(name, "")
    monkeypatch.setattr(os, "getuid", lambda: 0)
    before = getpass.getuser()
    name_the_user()
    assert os.environ["LOGNAME"] == ""
    assert getpass.getuser() == before
