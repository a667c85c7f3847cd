{% set lines = [] %}
{% for line in head %}
{% for part in (line.replace(";", ",")|wordwrap(30)).split("\n") %}
{% set _ = lines.append("  !" ~ part) %}
{% endfor %}
{% endfor %}
{% for pose in poses %}
{% set _ = lines.append("  MESSAGE[pose " ~ loop.index ~ " of " ~ poses|length ~ "]") %}
{% set _ = lines.append("J P[" ~ loop.index ~ "] " ~ speed ~ "% FINE") %}
{% set _ = lines.append("  WAIT " ~ "%6.2f"|format(settle) ~ "(sec)") %}
{% set _ = lines.append("  PR[" ~ loop.index ~ "]=JPOS") %}
{% set _ = lines.append("  DO[" ~ output ~ "]=PULSE,0.5sec" if output is not none else "  PAUSE") %}
{% endfor %}
/PROG  {{ name|upper }}
/ATTR
OWNER		= MNEDITOR;
COMMENT		= "calibration";
PROG_SIZE	= 0;
CREATE		= DATE 00-01-01  TIME 00:00:00;
MODIFIED	= DATE 00-01-01  TIME 00:00:00;
FILE_NAME	= ;
VERSION		= 0;
LINE_COUNT	= {{ lines|length }};
MEMORY_SIZE	= 0;
PROTECT		= READ_WRITE;
TCD:  STACK_SIZE	= 0,
      TASK_PRIORITY	= 50,
      TIME_SLICE	= 0,
      BUSY_LAMP_OFF	= 0,
      ABORT_REQUEST	= 0,
      PAUSE_REQUEST	= 0;
DEFAULT_GROUP	= 1,{{ '1' if group == 2 else '*' }},*,*,*;
CONTROL_CODE	= 00000000 00000000;
/MN
{% for line in lines %}
{{ "%4d"|format(loop.index) }}:{{ line }}    ;
{% endfor %}
/POS
{% for pose in poses %}
P[{{ loop.index }}]{
   GP1:
	UF : 0, UT : 1,	
{% for three in pose|batch(3) %}
{% set row = loop.index0 * 3 %}
{{ "\t" }}{% for value in three %}J{{ row + loop.index }}= {{ "%9s"|format(value) }} {{ "%3s"|format(units[row + loop.index0]) }}{{ ",\t" if row + loop.index < pose|length or group == 1 }}{% endfor %}

{% endfor %}
{% if group == 2 %}
   GP2:
	UF : 0, UT : 1,	
{% endif %}
{% if group %}
{% set letter = "EJ"[group - 1] %}
{{ "\t" }}{% for value in external[loop.index0] %}{{ letter }}{{ loop.index }}= {{ "%9s"|format(value) }} {{ "%3s"|format(units[pose|length + loop.index0]) }}{{ ",\t" if not loop.last }}{% endfor %}

{% endif %}
};
{% endfor %}
/END
