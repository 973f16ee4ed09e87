"""The default robot: a round holonomic base on four frictionless feet, with a lidar, and a camera on a mast."""

DEFAULT_ROBOT = """
<mujoco model="base">
  <option timestep="0.004"/>
  <default>
    <default class="foot">
      <geom type="sphere" size="0.1" mass="1" condim="1" priority="1" friction="0 0 0"/>
    </default>
  </default>
  <worldbody>
    <body name="base">
      <freejoint/>
      <geom type="cylinder" size="0.25 0.19" pos="0 0 0.31" mass="6" rgba="0.9 0.5 0.1 1"/>
      <geom class="foot" pos="0.15 0.15 0.1"/>
      <geom class="foot" pos="0.15 -0.15 0.1"/>
      <geom class="foot" pos="-0.15 0.15 0.1"/>
      <geom class="foot" pos="-0.15 -0.15 0.1"/>
      <site name="drive" pos="0 0 0.15"/>
      <site name="lidar" pos="0 0 0.4"/>
      <camera name="camera" pos="0 0 1.4" xyaxes="0 -1 0 0 0 1" fovy="50"/>
    </body>
  </worldbody>
  <actuator>
    <velocity name="forward" site="drive" gear="1 0 0 0 0 0" kv="60" ctrlrange="-1.5 1.5" forcerange="-30 30"/>
    <velocity name="left" site="drive" gear="0 1 0 0 0 0" kv="60" ctrlrange="-1.5 1.5" forcerange="-30 30"/>
    <velocity name="turn" site="drive" gear="0 0 0 0 0 1" kv="3" ctrlrange="-1.5 1.5" forcerange="-5 5"/>
  </actuator>
</mujoco>
"""
