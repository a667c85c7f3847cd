"""What programs say of their poses: tool, user frame and configuration, as each language writes them."""

from pathlib import Path

import numpy as np
import pytest

from calib.apps.controller_programs.languages import Setting, frames_in
from calib.apps.controller_programs.targets import read_program
from calib.errors import UsageError
from calib.transforms import from_xyz_rpy


def read(folder: Path, name: str, text: str, **further: str):
    path = folder / name
    path.write_text(text)
    return frames_in(read_program(path), further)


FANUC_POSE = """P[{0}]{{
   GP1:
\tUF : {1}, UT : {2},\t\tCONFIG : '{3}',
\tX =  1069.381  mm,\tY =  -692.393  mm,\tZ =   144.249  mm,
\tW =  -122.027 deg,\tP =    87.498 deg,\tR =   -34.134 deg
}};
"""
BACKUP = """[*SYSTEM*]$MNUFRAME  Storage: SHADOW  Access: RW  : ARRAY[4,20] OF POSITION
    [1,1] =
  Group: 1   Config: N D B, 0, 0, 0
  X:    10.000   Y:     0.000   Z:     0.000
  W:     0.000   P:     0.000   R:    90.000
    [2,1] =
  Group: 2   Config:
  X:    99.000   Y:     0.000   Z:     0.000
  W:     0.000   P:     0.000   R:     0.000

[*SYSTEM*]$MNUTOOL  Storage: SHADOW  Access: RW  : ARRAY[4,10] OF POSITION
    [1,3] =
  Group: 1   Config: N D B, 0, 0, 0
  X:     0.000   Y:     0.000   Z:   250.000
  W:     0.000   P:     0.000   R:     0.000
"""


def fanuc(*poses: str, lines: str = "   1:J P[1] 10% FINE ;\n") -> str:
    return "/PROG A\n/MN\n" + lines + "/POS\n" + "".join(poses) + "/END\n"


def test_fanuc_frames_and_configuration(tmp_path):
    """A Fanuc's frames and configuration are read."""
    text = fanuc(FANUC_POSE.format(1, 0, 1, "N U T, 0, 0, 0"), FANUC_POSE.format(2, 1, 3, "F D B, 0, 0, -1"))
    frames = read(tmp_path, "a.ls", text, backup=BACKUP)
    expected = Setting("UTOOL[1]", "UFRAME[0]", "N U T 0 0 0"), Setting("UTOOL[3]", "UFRAME[1]", "F D B 0 0 -1")
    assert frames.settings == expected
    np.testing.assert_allclose(frames.tools["UTOOL[3]"], from_xyz_rpy([0, 0, 0.25], [0, 0, 0]), atol=1e-15)
    np.testing.assert_allclose(frames.users["UFRAME[1]"], from_xyz_rpy([0.01, 0, 0], [0, 0, np.pi / 2]), atol=1e-15)
    assert "UTOOL[1]" not in frames.tools and "UFRAME[0]" in frames.users


@pytest.mark.parametrize(("lines", "tool"), [("UTOOL_NUM=3 ;\n", "UTOOL[3]"), ("UTOOL_NUM=3 ;\nUTOOL_NUM=4 ;\n", "")])
def test_fanuc_selects_its_active_frame_only(tmp_path, lines, tool):
    """A Fanuc's active frame is the only one that is selected."""
    frames = read(tmp_path, "a.ls", fanuc(FANUC_POSE.format(1, "F", "F", "N U T, 0, 0, 0"), lines=lines))
    assert frames.settings == (Setting(tool, "", "N U T 0 0 0"),)


def test_frames_stated_twice_are_refused(tmp_path):
    """Frames that are stated twice, with other numbers, are refused."""
    line = "UTOOL[1]: X {}, Y 0.0, Z 0.0 mm, W 0.0, P 0.0, R 0.0 deg\n"
    text = fanuc(FANUC_POSE.format(1, 0, 1, "N U T, 0, 0, 0"))
    with pytest.raises(UsageError, match=r"UTOOL\[1\] is given twice"):
        read(tmp_path, "a.ls", text, first=line.format("1.0"), second=line.format("2.0"))


KRL = """DEF b()
; $TOOL = TOOL_DATA[9]
$TOOL = TOOL_DATA[2]
$BASE={X 100,Y 0,Z 0,A 90,B 0,C 0} ; the table
LIN {X 1, Y 2, Z 3, A 9, B 10, C 11, S 2, T 35} C_DIS
BAS(#BASE,3)
$TOOL=$NULLFRAME
LIN {X 1, Y 2, Z 3, A 9, B 10, C 11, S 'B110', T 'B010010'}
LIN XA
$TOOL=TOOL_DATA[1]:{X 1,Y 2,Z 3,A 0,B 0,C 0}
LIN XB
LIN XC
$TOOL = TOOL_DATA[2]
LIN XC
DECL E6POS XA={X 1, Y 2, Z 3, A 9, B 10, C 11, S 2, T 35,E1 0}
E6POS XB={X 1, Y 2, Z 3, A 9, B 10, C 11, S 2, T 35}
E6POS XC={X 1, Y 2, Z 3, A 9, B 10, C 11, S 2, T 35}
DECL E6POS XP1={X 1, Y 2, Z 3, A 9, B 10, C 11, S 2, T 35,E1 0}
DECL FDAT FP1={TOOL_NO 4,BASE_NO 0,IPO_FRAME #BASE,POINT2[] " "}
TOOL_DATA[2]={X 7,Y 0,Z 0,A 0,B 0,C 0}
END
"""


def test_kuka_frames_of_selection_or_point(tmp_path):
    """A KUKA's frames are those selected before the motion, or the point's own."""
    frames = read(tmp_path, "b.src", KRL)
    assert [(setting.tool, setting.user) for setting in frames.settings] == [
        ("TOOL_DATA[2]", "$BASE of line 4"),
        ("$NULLFRAME", "BASE_DATA[3]"),
        ("$NULLFRAME", "BASE_DATA[3]"),
        ("TOOL_DATA[1]:{X1,Y2,Z3,A0,B0,C0}", "BASE_DATA[3]"),
        ("TOOL_DATA[1]:{X1,Y2,Z3,A0,B0,C0} or TOOL_DATA[2]", "BASE_DATA[3]"),
        ("TOOL_DATA[4]", "BASE_DATA[0]"),
    ]
    assert [setting.configuration for setting in frames.settings[:2]] == ["S 2 T 35", "S 6 T 18"]
    expected = from_xyz_rpy([0.1, 0, 0], [0, 0, np.pi / 2])
    np.testing.assert_allclose(frames.users["$BASE of line 4"], expected, atol=1e-15)
    assert frames.tools["TOOL_DATA[2]"][0, 3] == pytest.approx(0.007)
    assert "BASE_DATA[0]" in frames.users and "BASE_DATA[3]" not in frames.users


def test_a_kukas_tool_in_the_cell_is_refused(tmp_path):
    with pytest.raises(UsageError, match="#TCP"):
        read(tmp_path, "b.src", KRL.replace("IPO_FRAME #BASE", "IPO_FRAME #TCP"))


RAPID = r"""MODULE c
PERS tooldata tGrip:=[TRUE,[[0,0,120],[1,0,0,0]],[1,[0,0,50],[1,0,0,0],0,0,0]];
TASK PERS wobjdata w1:=[FALSE,TRUE,"",[[100,0,0],[1,0,0,0]],[[0,20,0],[1,0,0,0]]];
CONST robtarget p10:=[[600,0,500],[0,0,1,0],[0,-1,0,1],[9E9,9E9,9E9,9E9,9E9,9E9]];
CONST robtarget p20:=[[600,0,500],[0,0,1,0],[0,-1,0,1],[9E9,9E9,9E9,9E9,9E9,9E9]];
PROC m()
MoveL p10, v100, fine, tGrip\WObj:=w1;
MoveJ Offs(p10,0,0,10), v100\V:=20, z10\Z:=3, tGrip \WObj:=w1;
MoveL [[600,0,500],[0,0,1,0],[0,-1,0,1],[9E9,9E9,9E9,9E9,9E9,9E9]], v100, fine, tool0;
MoveL p20, v100, fine, tool0; MoveL p20, v100, fine, tGrip;
ENDPROC
ENDMODULE
"""


def test_abb_frames_are_those_of_its_moves(tmp_path):
    """An ABB's frames are those of the moves that use the target."""
    frames = read(tmp_path, "c.mod", RAPID)
    assert frames.settings == (
        Setting("tgrip", "w1", "0 -1 0 1"),
        Setting("tgrip or tool0", "wobj0", "0 -1 0 1"),
        Setting("tool0", "wobj0", "0 -1 0 1"),
    )
    np.testing.assert_allclose(frames.users["w1"][:3, 3], [0.1, 0.02, 0.0])
    np.testing.assert_allclose(frames.tools["tgrip"][:3, 3], [0.0, 0.0, 0.12])


@pytest.mark.parametrize(("old", "new"), [("tGrip:=[TRUE", "tGrip:=[FALSE"), ("w1:=[FALSE", "w1:=[TRUE")])
def test_abb_frame_on_other_side_is_refused(tmp_path, old, new):
    """An ABB's frame on the other side is refused."""
    with pytest.raises(UsageError, match="robhold"):
        read(tmp_path, "c.mod", RAPID.replace(old, new))


def test_ur_tool_is_the_one_set_before_move(tmp_path):
    """A UR's tool is the one set before the move."""
    text = """def d():
  movel(p[0.4,0.1,0.3,0,3.14,0], a=1)
  # set_tcp(p[9,9,9,0,0,0])
  set_tcp(p[0,0,0.1,0,0,0])
  movel(p[0.4,0.1,0.3,0,3.14,0], a=1)
  set_tcp(get_target_tcp_pose())
  movej(p[0.4,0.1,0.3,0,3.14,0], a=1)
end
"""
    frames = read(tmp_path, "d.script", text)
    assert [setting.tool for setting in frames.settings] == ["", "set_tcp of line 4", "set_tcp of line 6"]
    assert set(frames.tools) == {"set_tcp of line 4"} and frames.tools["set_tcp of line 4"][2, 3] == 0.1
