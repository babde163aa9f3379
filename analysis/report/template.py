# ruff: noqa: E501 - lines of a page, not of a program
"""The page's text in Jinja's language; all that is put in is escaped but the figures."""

from __future__ import annotations

PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>Spray report: {{ flight.file }}</title>
<style>{{ stylesheet }}</style>
</head>
<body>
<header>
<h1>Spray report</h1>
<p class="quiet">{{ flight.told.get("application.field_name") or flight.file }}\
{% if flight.spraying_from or flight.started %}, {{ (flight.spraying_from or flight.started)|moment }} ({{ flight.time_zone }}){% endif %}</p>
{% for each in warnings if each.severity == "mark" %}<p class="mark">{{ each.text }}</p>
{% endfor %}<p class="verdict">{{ verdict.sentence }}</p>
{% if evaluated %}<div class="tiles">
{{ tile(verdict.applied_l|f(2) ~ " L", "applied, " ~ verdict.prescribed_l|f(2) ~ " L prescribed") }}
{{ tile(verdict.area_ha|f(3) ~ " ha", "treated") }}
{{ tile(verdict.within_10_percent|f(1) ~ " %", "of the ground within 10 % of its rate") }}
{{ tile(lag_distance_m.mean_abs|f(2) ~ " m", "early or late where the rate changes (mean of " ~ lag_distance_m.count ~ "; worst " ~ verdict.worst_lag_distance_m|f(2) ~ " m)") }}
{{ tile(verdict.outside_ml|f(1) ~ " mL", "fell outside the border") }}
</div>
{% endif %}<dl class="head">
<dt>What</dt><dd>{{ flight.told.get("product.name") or "product not named" }}\
{% if flight.told.get("application.crop") %}, on {{ flight.told["application.crop"] }}{% endif %}</dd>
<dt>Where</dt><dd>{{ flight.latitude_deg|f(6) }}, {{ flight.longitude_deg|f(6) }} (WGS84)\
{% if flight.told.get("application.parcel") %}, parcel {{ flight.told["application.parcel"] }}{% endif %}</dd>
<dt>When</dt><dd>{% if flight.spraying_from %}sprayed {{ flight.spraying_from|moment }} to {{ flight.spraying_until|moment }}\
{% elif flight.started %}flown {{ flight.started|moment }} to {{ flight.ended|moment }}{% else %}not known{% endif %};
{% if flight.duration_s is not none %}{{ flight.duration_s|duration }} in the air; {% endif %}time zone {{ flight.time_zone }}; {{ flight.clock }}</dd>
<dt>Who</dt><dd>{{ flight.told.get("application.operator") or flight.told.get("application.pilot") or "operator not named" }}\
{% if flight.told.get("application.customer") %}, for {{ flight.told["application.customer"] }}{% endif %}</dd>
<dt>Journal</dt><dd>{{ flight.file }}, SHA-256 <code>{{ flight.sha256 }}</code></dd>
</dl>
<ul class="warnings">
{% for each in warnings if each.severity != "mark" %}<li class="{{ each.severity }}">{{ each.text }}</li>
{% endfor %}{% for each in notes or [] %}<li class="note">{{ each[:1]|upper }}{{ each[1:] }}.</li>
{% endfor %}</ul>
</header>
<main>
{% if evaluated %}
<h2>On the ground</h2>
{{ fig("map") }}{{ fig("deviation") }}
<p class="quiet">Prescribed and applied are litres of spray liquid per hectare at the nozzle. <a href="#definitions">What the figures mean</a>.</p>
<h2>Flow</h2>
{{ fig("flow") }}
<h2>Changes of rate</h2>
<p>Mean of absolute values {{ lag_distance_m.mean_abs|f(3) }} m
(95 % interval {{ intervals.lag_distance_abs_m|span(3) }} m), mean {{ lag_distance_m.mean|signed(3) }} m,
worst {{ lag_distance_m.max_abs|f(3) }} m, of {{ lag_distance_m.count }} changes in
{{ intervals.lag_distance_m.clusters }} crossings; {{ apart }} apart, {{ missed }} missed.
<a href="#definitions">What the figures mean</a>.</p>
<table><caption>Beside the published flights of Wang et al. 2024 ({{ published.source }}) with a real sprayer, at 5 m/s</caption>
<thead><tr><th></th><th class="n">settled lag distance, mean [m]</th><th class="n">spraying accuracy, mean [%]</th></tr></thead><tbody>
<tr><td>this flight, at {{ speeds_text }}</td><td class="n">{{ settled_lag_distance_m.mean|signed(2) }} <small>n {{ settled_lag_distance_m.count }}{% if settled_lag_distance_m.missed %}, {{ settled_lag_distance_m.missed }} never settled{% endif %}</small></td><td class="n">{{ spraying_accuracy_percent|f(2) }}</td></tr>
<tr><td>published, with lag compensation</td><td class="n">{{ published.lag_distance_m["look-ahead"][0].mean|signed(2) }}</td><td class="n">{{ published.spraying_accuracy_percent.mean|f(2) }} <small>4 to 6 m/s</small></td></tr>
<tr><td>published, without</td><td class="n">{{ published.lag_distance_m.none[0].mean|signed(2) }}</td><td class="n">-</td></tr>
</tbody></table>
<p class="quiet">The settled distance has its sign: early and late cancel. Theirs was measured by a flow meter, ours is modelled from the executed changes.\
{% if settled_lag_distance_m.missed %} It judges the flow of the whole boom by the rate under its middle, as in plots as wide as the boom. \
Where rates differ across the boom that flow changes with each valve's own boundary, and often never settles: there the lag distance by valve, above and below, is the one to read.{% endif %}</p>
{{ fig("lags") }}
{{ groups("By kind of change", breakdowns.by_kind) }}
{{ groups("By size of the step", breakdowns.by_step) }}
{{ groups("By rate that the change leads to", breakdowns.by_rate) }}
{{ groups("By speed", breakdowns.by_speed) }}
{{ groups("Settled lag distance by rate (P1, Fig. 8a)", breakdowns.settled_by_rate) }}
{{ groups("Settled lag distance by speed (P1, Fig. 8b)", breakdowns.settled_by_speed) }}
<h2>Spraying accuracy</h2>
<p>{{ spraying_accuracy_percent|f(2)|percent }} (95 % interval {{ intervals.spraying_accuracy_percent|span(2) }} %),
starting {{ starting_accuracy_percent|f(2)|percent }}, settled {{ settled_accuracy_percent|f(2)|percent }};
{{ breakdowns.undefined_samples }} samples with nothing prescribed are left out.
Misapplied {{ misapplied_percent|f(2) }} % (95 % interval {{ intervals.misapplied_percent|span(2) }} %).</p>
{% if table_5.rows_shown %}<div class="scroll"><table>
<caption>Spraying accuracy [%] by rate and speed, as Table 5 of Wang et al. 2024 (there 91.56 to 97.32, mean 94.77)</caption>
<thead><tr><th>rate [L/ha]</th>{% for low, high in table_5.speeds_m_s %}<th class="n">{{ low|f(2) }} to {{ high|f(2) }} m/s</th>{% endfor %}</tr></thead>
<tbody>{% for row in table_5.rows_shown %}<tr><td>{{ "several" if row.rate_l_ha is none else row.rate_l_ha|f(1) }}</td>\
{% for each in row.percent %}<td class="n">{% if each %}{{ each.mean|f(2) }} <small>n {{ each.count }}</small>{% endif %}</td>{% endfor %}</tr>
{% endfor %}</tbody></table></div>
{% if table_5.rows|length > table_5.rows_shown|length %}<p class="quiet">{{ table_5.rows|length - table_5.rows_shown|length }} more rates are in report.json.</p>{% endif %}
{% endif %}
{{ fig("histogram") }}{{ fig("duty") }}
<h2>Ground off its rate</h2>
<p>{{ causes.off_m2|f(1) }} m\u00b2 of {{ causes.judged_m2|f(1) }} m\u00b2 are more than 10 % off
({{ causes.within_10_percent|f(1) }} % are within). Treated twice: {{ causes.doubled_m2|f(1) }} m\u00b2; left out between passes:
{{ causes.skipped_m2|f(1) }} m\u00b2; of the field not sprayed in this flight: {{ causes.untreated_m2|f(1) }} m\u00b2.</p>
{{ fig("causes") }}
<h2>Volume balance</h2>
<table><thead><tr><th>by</th><th class="n">L</th><th class="n">against the prescribed</th><th class="n">against the model</th></tr></thead><tbody>
<tr><td>prescription, on the ground flown over</td><td class="n">{{ balance.prescribed_l|f(3) }}</td><td></td><td></td></tr>
<tr><td>model: executed changes, calibrated curves, lags</td><td class="n">{{ balance.model_l|f(3) }}</td><td class="n">{{ balance.model_to_prescribed_percent|signed(2)|percent }}</td><td></td></tr>
<tr><td>flow meter{% if balance.meter_spread_percent is not none %} (\u00b1{{ balance.meter_spread_percent|f(1) }} %){% endif %}</td><td class="n">{{ balance.meter_l|f(3) }}</td><td class="n">{{ balance.meter_to_prescribed_percent|signed(2)|percent }}</td><td class="n">{{ balance.meter_to_model_percent|signed(2)|percent }}</td></tr>
<tr><td>tank{% if balance.tank_start_l is not none %} ({{ balance.tank_start_l|f(2) }} L to {{ balance.tank_end_l|f(2) }} L, refilled {{ balance.refilled_l|f(2) }} L){% endif %}</td><td class="n">{{ balance.tank_l|f(3) }}</td><td></td><td class="n">{{ balance.tank_to_model_percent|signed(2)|percent }}</td></tr>
</tbody></table>
<p>Border: margin {{ border_margin_m.mean|f(3) }} m in the mean, least {{ border_margin_m.min|f(3) }} m of {{ border_margin_m.count }} crossings;
gaps at switches {{ gap_m2|f(2) }} m\u00b2, overlap {{ overlap_m2|f(2) }} m\u00b2.</p>
{% endif %}
<h2>Time and events</h2>
{% if evaluated %}<table><thead><tr><th>valves held closed by</th><th class="n">s</th></tr></thead><tbody>
{% for name, value in durations.by_inhibit_s.items() %}<tr><td>{{ name }}</td><td class="n">{{ value|f(1) }}</td></tr>
{% else %}<tr><td>nothing</td><td class="n">0</td></tr>
{% endfor %}</tbody></table>
<p class="quiet">{{ durations.recorded_s|f(1) }} s recorded, {{ durations.spraying_s|f(1) }} s spraying.</p>{% endif %}
{% if events %}<table><thead><tr><th>time</th><th>event</th><th>text</th></tr></thead><tbody>
{% for each in events_shown %}<tr><td>{{ each.time or (each.time_s|f(1) ~ " s") }}</td><td>{{ each.kind }}</td><td>{{ each.text }}</td></tr>
{% endfor %}</tbody></table>
{% if events|length > events_shown|length %}<p class="quiet">{{ events|length - events_shown|length }} more are in report.json.</p>{% endif %}
{% else %}<p>No events were recorded.</p>{% endif %}
<h2>Record of the application</h2>
{{ fig("treated") }}
{% for profile, record in application.items() %}
<h3>{{ record.law[:1]|upper }}{{ record.law[1:] }}</h3>
{% if record.complete %}<p>Complete: every field that this record asks for has a value.</p>
{% else %}<p class="incomplete">INCOMPLETE. Missing: {{ record.missing|join(", ") }}.</p>{% endif %}
{% if not record.complete %}<p class="quiet">What is known and only missing here is given by --set KEY=VALUE or --application FILE to vrspray report, and is marked as said after the flight.</p>{% endif %}
{% if record.added_after_flight %}<p>Added after the flight: {{ record.added_after_flight|join(", ") }}.</p>{% endif %}
<table class="record"><thead><tr><th>field</th><th>value</th><th>said</th></tr></thead><tbody>
{% for name, entry in record.fields.items() %}<tr{% if name in record.missing %} class="missing"{% endif %}><td>{{ entry.label }}</td>\
<td>{% if name in record.missing %}MISSING{% elif entry.value is none %}-{% else %}{{ entry.value }} {{ entry.unit }}{% endif %}\
{% if entry.replaced is defined %} <small>(before: {{ entry.replaced }})</small>{% endif %}</td><td>{{ entry.said }}</td></tr>
{% endfor %}</tbody></table>
{% for each in record.remarks %}<p class="quiet">Remark: {{ each }}.</p>{% endfor %}
<p class="quiet">{{ record.retention[:1]|upper }}{{ record.retention[1:] }}. The treated area as geodata is in application-{{ profile }}.json and in report.json.</p>
{% endfor %}
<h2>Set-up</h2>
<dl class="head">
<dt>Method</dt><dd>{{ setup.method }}, border: {{ setup.border }}, across: {{ setup.across }}</dd>
<dt>Lags</dt><dd>{% for name, value in setup.lag.items() if value is number %}{{ name }} = {{ value }}{{ ", " if not loop.last }}{% endfor %}; reference: {{ setup.lag.reference }}</dd>
<dt>Boom</dt><dd>{{ setup.boom.width_m|f(2) }} m, {{ setup.boom.valves|length }} valves, {{ setup.pwm.frequency_hz|f(1) }} Hz, duty {{ setup.pwm.duty_min }} to {{ setup.pwm.duty_max }}</dd>
<dt>Nozzles</dt><dd>{% for each in setup.nozzle_sets %}valves {{ each["valves"]|join(", ") }}: \
{% for d, q in each.pairs %}{{ d }}: {{ q|f(3) }} L/min{{ ", " if not loop.last }}{% endfor %}{{ "; " if not loop.last }}{% endfor %}</dd>
<dt>Map</dt><dd>SHA-256 <code>{{ setup.map_sha256 or "not known" }}</code></dd>
<dt>Configuration</dt><dd>{{ setup.config_path or "" }} SHA-256 <code>{{ setup.config_sha256 or "not known" }}</code></dd>
<dt>Calibration</dt><dd>SHA-256 <code>{{ setup.calibration_sha256 or "not in this journal" }}</code></dd>
<dt>Versions</dt><dd>{% for name, value in setup.versions.items() %}{{ name }} {{ value }}{{ ", " if not loop.last }}{% endfor %}; {{ setup.platform or "" }}</dd>
</dl>
{% if setup.config_toml %}<details><summary>The configuration as it was flown</summary><pre>{{ setup.config_toml }}</pre>
{% if setup.config_overrides %}<pre>{{ setup.config_overrides }}</pre>{% endif %}</details>{% endif %}
<h2 id="definitions">What the figures mean</h2>
<table><tbody>{% for key, each in definitions.items() %}<tr><td class="k">{{ each.name }}</td><td class="k">{{ each.unit }}</td><td>{{ each.text }}</td></tr>
{% endfor %}</tbody></table>
<p class="quiet">Figures are at the nozzle: where droplets land also depends on wind, tilt and droplet size. Made by {{ program.name }} {{ program.version }}.</p>
</main>
<script type="application/json" id="report">{{ data }}</script>
</body>
</html>
"""

MACROS = """
{% macro tile(value, text) %}<div class="tile"><b>{{ value }}</b><span>{{ text }}</span></div>{% endmacro %}
{% macro fig(name) %}{% if figures[name] %}<figure id="{{ name }}"><h3>{{ figures[name].title }}</h3>
{{ figures[name].markup }}<figcaption>{{ figures[name].caption }}</figcaption></figure>
{% endif %}{% endmacro %}
{% macro groups(title, rows) %}{% if rows %}<div class="scroll"><table><caption>{{ title }}</caption>
<thead><tr><th></th><th class="n">changes</th><th class="n">mean [m]</th><th class="n">95 % [m]</th><th class="n">mean abs. [m]</th><th class="n">worst [m]</th><th class="n">apart</th><th class="n">missed</th></tr></thead><tbody>
{% for each in rows[:40] %}<tr><td class="k">{{ each.name }}</td><td class="n">{{ each.lag_distance_m.count }}</td><td class="n">{{ each.lag_distance_m.mean|signed(3) }}</td>\
<td class="n">{{ each.lag_distance_m|span(3) }}</td><td class="n">{{ each.lag_distance_abs_m.mean|f(3) }}</td><td class="n">{{ each.max_abs_m|f(3) }}</td><td class="n">{{ each.apart }}</td><td class="n">{{ each.missed }}</td></tr>
{% endfor %}</tbody></table></div>
{% if rows|length > 40 %}<p class="quiet">{{ rows|length - 40 }} more rows are in report.json.</p>{% endif %}{% endif %}{% endmacro %}
"""
