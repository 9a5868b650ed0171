"""Robots as files: a gripper whose second finger mimics the first, as URDF and as SDF, a laptop, and a real arm."""

import os
from pathlib import Path
from xml.etree import ElementTree

from trimesh.creation import box

GRIPPER = """\
<robot name="gripper">
  <link name="world"/>
  <link name="palm">
    <visual><geometry>
      <mesh filename="package://grasping/meshes/palm.stl" scale="0.001 0.001 0.001"/>
    </geometry></visual>
  </link>
  <link name="knob"><visual><geometry><cylinder radius="0.012" length="0.05"/></geometry></visual></link>
  <link name="left">
    <visual><geometry><mesh filename="../meshes/finger.stl" scale="0.001 0.001 0.001"/></geometry></visual>
  </link>
  <link name="right">
    <visual><geometry><mesh filename="../meshes/finger.stl" scale="-0.001 0.001 0.001"/></geometry></visual>
  </link>
  <link name="tip"/>
  <joint name="mount" type="fixed"><parent link="world"/><child link="palm"/></joint>
  <joint name="screw" type="fixed">
    <parent link="palm"/><child link="knob"/><origin xyz="-0.03 0 -0.03"/>
  </joint>
  <joint name="finger" type="prismatic">
    <parent link="palm"/><child link="left"/><origin xyz="-0.01 0 0.047"/><axis xyz="-2 0 0"/>
    <limit lower="0.003" upper="0.035" effort="1" velocity="1"/>
  </joint>
  <joint name="other finger" type="prismatic">
    <parent link="palm"/><child link="right"/><origin xyz="0.01 0 0.047" rpy="0 0 1.5707963267948966"/>
    <axis xyz="0 -1 0"/><limit lower="0" upper="0" effort="1" velocity="1"/>
    <mimic joint="finger" multiplier="0.5" offset="0.002"/>
  </joint>
  <joint name="spin" type="continuous"><parent link="left"/><child link="tip"/><axis xyz="0 0 1"/></joint>
</robot>
"""

GRIPPER_SDF = """\
<sdf version="1.11"><model name="gripper">
  <link name="palm">
    <visual name="a"><geometry><mesh><uri>model://grasping/meshes/palm.stl</uri><scale>.001 .001 .001</scale></mesh>
    </geometry></visual>
    <visual name="b"><pose>-0.03 0 -0.03 0 0 0</pose>
      <geometry><cylinder><radius>0.012</radius><length>0.05</length></cylinder></geometry></visual>
  </link>
  <link name="left"><pose relative_to="finger"/>
    <visual name="a"><geometry><mesh><uri>../meshes/finger.stl</uri><scale>.001 .001 .001</scale></mesh></geometry>
    </visual>
  </link>
  <link name="right"><pose degrees="true">0.01 0 0.047 0 0 90</pose>
    <visual name="a"><geometry><mesh><uri>../meshes/finger.stl</uri><scale>-.001 .001 .001</scale></mesh></geometry>
    </visual>
  </link>
  <joint name="mount" type="fixed"><parent>world</parent><child>palm</child></joint>
  <joint name="finger" type="prismatic"><parent>palm</parent><child>left</child>
    <pose relative_to="palm">-0.01 0 0.047 0 0 0</pose>
    <axis><xyz>-2 0 0</xyz><limit><lower>0.003</lower><upper>0.035</upper></limit></axis>
  </joint>
  <joint name="other finger" type="prismatic"><parent>palm</parent><child>right</child>
    <axis><xyz expressed_in="__model__">1 0 0</xyz>
      <mimic joint="finger"><multiplier>0.5</multiplier><offset>0.004</offset><reference>0.004</reference></mimic>
    </axis>
  </joint>
</model></sdf>
"""

LAPTOP = """\
<robot name="laptop">
  <link name="base"><visual><geometry><box size="0.3 0.2 0.02"/></geometry></visual></link>
  <link name="lid">
    <visual><origin xyz="0 0.1 0"/><geometry><box size="0.3 0.2 0.01"/></geometry></visual>
    <visual><origin xyz="0.1 0.15 0.01"/><geometry><sphere radius="0.015"/></geometry></visual>
  </link>
  <joint name="hinge" type="revolute">
    <parent link="base"/><child link="lid"/><origin xyz="0 -0.1 0.016"/><axis xyz="1 0 0"/>
    <limit lower="0.3" upper="2.2" effort="1" velocity="1"/>
  </joint>
</robot>
"""

LAMP = """\
<robot name="lamp">
  <link name="foot"><visual><geometry><box size="0.2 0.14 0.03"/></geometry></visual></link>
  <link name="arm">
    <visual><origin xyz="0 0 0.1"/><geometry><box size="0.03 0.05 0.2"/></geometry></visual>
  </link>
  <link name="boom">
    <visual><origin xyz="0 0 0.09"/><geometry><box size="0.05 0.03 0.18"/></geometry></visual>
  </link>
  <link name="head"><visual><origin xyz="0.04 0 0.05"/><geometry><box size="0.12 0.07 0.05"/></geometry></visual></link>
  <joint name="turn" type="revolute"><parent link="foot"/><child link="arm"/><origin xyz="0 0 0.02"/>
    <axis xyz="0 0 1"/><limit lower="-2.5" upper="2.5" effort="1" velocity="1"/></joint>
  <joint name="bend" type="revolute"><parent link="arm"/><child link="boom"/><origin xyz="0 0 0.21"/>
    <axis xyz="0 1 0"/><limit lower="-2.2" upper="2.2" effort="1" velocity="1"/></joint>
  <joint name="nod" type="revolute"><parent link="boom"/><child link="head"/><origin xyz="0 0 0.19"/>
    <axis xyz="1 0 0"/><limit lower="-2.2" upper="2.2" effort="1" velocity="1"/></joint>
</robot>
"""
"""Three joints that turn far, in states of which modes have but some."""

LAPTOP_SDF = """\
<sdf version="1.7"><world name="w"><model name="laptop">
  <frame name="back" attached_to="base"><pose>0 -0.1 0.016 0 0 0</pose></frame>
  <link name="base"><collision name="a"><geometry><box><size>0.3 0.2 0.02</size></box></geometry></collision></link>
  <link name="lid"><pose relative_to="back">0 0.1 0 0 0 0</pose>
    <collision name="a"><geometry><box><size>0.3 0.2 0.01</size></box></geometry></collision>
    <collision name="b"><pose>0.1 0.05 0.01 0 1.5707963 0</pose>
      <geometry><capsule><radius>0.015</radius><length>0.02</length></capsule></geometry></collision>
  </link>
  <joint name="hinge" type="revolute"><parent>base</parent><child>lid</child><pose>0 -0.1 0 0 0 0</pose>
    <axis><xyz>1 0 0</xyz><limit><lower>0.3</lower><upper>2.2</upper></limit></axis>
  </joint>
</model></world></sdf>
"""


ASSETS = Path(os.environ.get("MEREO_ASSETS", "/absent"))
"""Folder of files that are not in the repository."""

SALAMANDER = ASSETS / "lizard/salamander.sdf"
"""Of Pazzaglia's simulations, MIT licence: legs of spheres and of capsules with a radius of a millimetre."""

ARM = ASSETS / "robot/so101_new_calib.urdf"
"""The SO-101, Apache 2.0 licence; its meshes are united to one for each link, in the link's frame."""


def write_arm(path: Path) -> Path:
    """Write the real arm's file, with the meshes of its links that are next to it as their only shapes."""
    tree = ElementTree.parse(ARM)
    for link in tree.iter("link"):
        for shape in [*link.findall("visual"), *link.findall("collision")]:
            link.remove(shape)
        mesh = ARM.with_name(f"so101_{link.get('name')}.obj")
        if mesh.is_file():
            geometry = ElementTree.SubElement(ElementTree.SubElement(link, "visual"), "geometry")
            ElementTree.SubElement(geometry, "mesh", filename=str(mesh))
    tree.write(path)
    return path


def write_gripper(folder: Path) -> Path:
    """Write the package "grasping" with the gripper's meshes in millimetres, and return its URDF file."""
    for name in ("meshes", "urdf"):
        (folder / "grasping" / name).mkdir(parents=True, exist_ok=True)
    palm = box((100, 50, 30)).union(box(bounds=[[5, -10, -50], [35, 20, 0]]))
    finger = box((12, 30, 60)).union(box(bounds=[[-3, -6, 14], [27, 6, 26]]))
    for name, mesh in (("palm", palm), ("finger", finger)):
        mesh.export(folder / f"grasping/meshes/{name}.stl")
    path = folder / "grasping/urdf/gripper.urdf"
    path.write_text(GRIPPER)
    path.with_suffix(".sdf").write_text(GRIPPER_SDF)
    return path
