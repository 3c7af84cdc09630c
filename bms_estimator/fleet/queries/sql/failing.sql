-- Packs with a faulty cell or an alarm of one, packs that will soon reach a limit, and packs with recent input faults. Needs: hours, packs, days, fits.
WITH limits(quantity, limit_value, shown, sense) AS (
    VALUES ('capacity', ln($capacity_limit), 'capacity_ratio', -1), ('r_s', ln($r_s_limit), 'r_s_ratio', 1),
        ('margin', 0.0, 'stability_margin_min', -1)
),
-- sense: -1 if the quantity falls towards its limit, 1 if it rises. x: years from the weighted mean time of the points, at which the errors of level and slope are independent. The
-- confidence band of the line reaches the limit at the roots of a x^2 + 2 b x + c = 0 (Fieller's theorem).
bands AS (
    SELECT
        f.*, shown, sense, limit_value,
        slope ^ 2 - (t_quantile * slope_std) ^ 2 AS a,
        (mean - limit_value) * slope AS b,
        (mean - limit_value) ^ 2 - (t_quantile * mean_std) ^ 2 AS c
    FROM fits f JOIN limits USING (quantity)
),
ends AS (
    SELECT
        *,
        CASE WHEN b ^ 2 >= a * c AND a <> 0 THEN least((-b - sqrt(b ^ 2 - a * c)) / a, (-b + sqrt(b ^ 2 - a * c)) / a) END AS x_low,
        CASE WHEN b ^ 2 >= a * c AND a <> 0 THEN greatest((-b - sqrt(b ^ 2 - a * c)) / a, (-b + sqrt(b ^ 2 - a * c)) / a) END AS x_high
    FROM bands
),
trends AS (
    SELECT
        pack, shown AS quantity,
        CASE quantity WHEN 'margin' THEN today ELSE exp(today) END AS value,
        CASE quantity WHEN 'margin' THEN limit_value ELSE exp(limit_value) END AS limit_value,
        CASE quantity WHEN 'margin' THEN slope ELSE exp(today) * slope END AS per_year,
        CASE WHEN sense * (today - limit_value) >= 0 THEN 0 ELSE 365.25 * (limit_value - today) / slope END AS days_left,
        CASE WHEN a > 0 THEN 365.25 * (x_low + middle) END AS earliest,
        CASE WHEN a > 0 THEN 365.25 * (x_high + middle) END AS latest,
        -- significance of the trend towards the limit, or of the present value beyond the limit
        greatest(sense * slope / slope_std, sense * (today - limit_value) / today_std) AS stds
    FROM ends
    WHERE sense * slope > 0 OR sense * (today - limit_value) >= 0
),
-- Input faults that the filter reports at the end of most of the recent days, and reported on less than 10 % of the days
-- before
suspected AS (
    SELECT
        pack, 'suspect: ' || name AS quantity,
        avg(CASE WHEN suspects & bit > 0 THEN 1 ELSE 0 END) FILTER (day > $today - $recent_days) AS value,
        NULL::DOUBLE AS limit_value, NULL::DOUBLE AS per_year, 0.0 AS days_left, NULL::DOUBLE AS earliest,
        NULL::DOUBLE AS latest, NULL::DOUBLE AS stds
    FROM days, (SELECT unnest($suspect_bits) AS bit, unnest($suspect_names) AS name)
    GROUP BY pack, name
    HAVING value > 0.5
        AND coalesce(avg(CASE WHEN suspects & bit > 0 THEN 1 ELSE 0 END) FILTER (day <= $today - $recent_days), 1) < 0.1
),
-- Other alarms, such as cell_imbalance in volts, are also raised in healthy packs
raised AS (
    SELECT
        pack, 'alarm: ' || alarm AS quantity, NULL::DOUBLE AS value, NULL::DOUBLE AS limit_value, NULL::DOUBLE AS per_year,
        0.0 AS days_left, NULL::DOUBLE AS earliest, NULL::DOUBLE AS latest, NULL::DOUBLE AS stds
    FROM (
        SELECT pack, unnest(string_split(arg_max_null(alarms, hour), ' ')) AS alarm
        FROM hours WHERE hour // 24 > $today - $recent_days GROUP BY pack
    )
    WHERE alarm IN ('weak_cell', 'cell_short')
),
recent AS (
    SELECT *, count(*) OVER (PARTITION BY pack) AS hours FROM hours
    WHERE weakest_cell IS NOT NULL AND hour // 24 > $today - $recent_days
),
-- margin: several standard deviations, which must be between value and limit
cell_values AS (
    SELECT pack, hours, weakest_cell AS cell, 'cell SOC' AS quantity, weakest_cell_soc_deviation AS value,
        -$weak_cell_soc AS limit_value, 'below' AS sense, 3 * weakest_cell_soc_deviation_std AS margin
    FROM recent
    UNION ALL
    SELECT pack, hours, smallest_cell, 'cell capacity', smallest_cell_capacity_ratio, $small_cell_ratio, 'below', 0 FROM recent
    UNION ALL
    SELECT pack, hours, resistive_cell, 'cell resistance', resistive_cell_ratio, $resistive_cell_ratio, 'above',
        2 * resistive_cell_ratio_std
    FROM recent
    UNION ALL
    SELECT pack, hours, self_discharge_cell, 'cell self-discharge', self_discharge_a, $self_discharge_c * capacity_ah, 'above',
        greatest($stds * self_discharge_std_a - $self_discharge_c * capacity_ah, 0)
    FROM recent
),
cells AS (
    SELECT
        pack, cell, quantity, median(value) AS value, any_value(limit_value) AS limit_value, NULL::DOUBLE AS per_year,
        0.0 AS days_left, NULL::DOUBLE AS earliest, NULL::DOUBLE AS latest, NULL::DOUBLE AS stds
    FROM cell_values
    WHERE CASE sense WHEN 'below' THEN value + margin < limit_value ELSE value - margin > limit_value END
    GROUP BY pack, cell, quantity
    HAVING count(*) > 0.5 * any_value(hours)
)
SELECT
    type, pack, quantity, cell, value, limit_value AS "limit", per_year, days_left,
    greatest(earliest, 0) AS days_left_low, latest AS days_left_high, stds
FROM (
    SELECT * FROM cells
    UNION ALL BY NAME SELECT * FROM trends WHERE stds > $stds AND days_left <= $within_days
    UNION ALL BY NAME SELECT * FROM suspected
    UNION ALL BY NAME SELECT * FROM raised
)
JOIN packs USING (pack)
ORDER BY days_left, cell IS NULL, stds DESC, pack, quantity
