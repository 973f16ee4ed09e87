"""What a scene is on disk. Of our packages, nerfstudio imports this one first, before torch's compiler."""

from dataparsers.user import name_the_user

name_the_user()
