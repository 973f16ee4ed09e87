"""What a scene is on disk. Of our packages, nerfstudio imports this one first, before torch's compiler."""

from dataparsers.user import name_the_user
from shellgs_method.errors import print_what_can_be

name_the_user()
print_what_can_be()
