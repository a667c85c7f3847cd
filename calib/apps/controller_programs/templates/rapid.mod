MODULE {{ name }}
  ! {{ poses|length }} poses for a calibration; written by armature-calib.
{% for line in head %}
  ! {{ line }}
{% endfor %}
  PROC {{ name }}_run()
    VAR iodev file;
    Open "HOME:" \File:="calib_joints.csv", file \Write;
    Write file, "row,{% for joint in joints %}{{ joint }} [{{ units[loop.index0] }}]{{ "," if not loop.last }}{% endfor %}";
    VelSet {{ speed }}, 5000;
{% for pose in poses %}
    TPWrite "pose {{ loop.index }} of {{ poses|length }}";
    MoveAbsJ [[{{ (pose + ["0", "0"])[:6]|join(", ") }}], [{{ (external[loop.index0] + ["9E9"] * 6)[:6]|join(", ") }}]], v1000, fine, tool0;
    WaitTime \InPos, {{ settle }};
    {{ name }}_read file, {{ loop.index }};
{% endfor %}
    Close file;
  ENDPROC

  PROC {{ name }}_read(VAR iodev file, num row)
    VAR jointtarget at;
{% if output is none %}
    VAR num key;
{% endif %}
    at := CJointT();
    Write file, NumToStr(row, 0) \NoNewLine;
{% for _ in poses[0] %}
    Write file, "," + NumToStr(at.robax.rax_{{ loop.index }}, 6) \NoNewLine;
{% endfor %}
{% for _ in external[0] %}
    Write file, "," + NumToStr(at.extax.eax_{{ "abcdef"[loop.index0] }}, 6) \NoNewLine;
{% endfor %}
    Write file, "";
{% if output is not none %}
    PulseDO \PLength:=0.5, do{{ output }};
{% else %}
    TPReadFK key, "Measure this pose.", "", "", "", "", "Next";
{% endif %}
  ENDPROC
ENDMODULE
