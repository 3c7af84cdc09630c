-- Series cells with a significant self-discharge: as the worker has estimated it at the end of the last hour of a pack in the
-- recent days, or by the trend of the SOC deviation of the weakest cell. Needs: hours, packs.
WITH last_hours AS (
    SELECT pack, max_by(hours, hour) AS h
    FROM hours
    WHERE self_discharge_a IS NOT NULL AND hour // 24 > $today - $recent_days
    GROUP BY pack
),
estimates AS (
    SELECT
        pack, h.self_discharge_cell AS cell, 'estimate' AS method, h.capacity_ah AS capacity_ah,
        h.self_discharge_a AS current_a, h.self_discharge_std_a AS std_a
    FROM last_hours
),
weakest_days AS (
    SELECT
        pack, weakest_cell AS cell, hour // 24 AS day, avg(weakest_cell_soc_deviation) AS soc, any_value(capacity_ah) AS capacity_ah
    FROM hours
    WHERE weakest_cell_soc_deviation IS NOT NULL
    GROUP BY ALL
),
lines AS (
    SELECT
        pack, cell, count(*) AS n, max(capacity_ah) AS capacity_ah, regr_slope(soc, day) AS slope,
        regr_sxx(soc, day) AS information, regr_syy(soc, day) AS total
    FROM weakest_days
    GROUP BY pack, cell
    HAVING count(*) >= $min_days AND max(day) > $today - $recent_days
),
-- the standard deviation of the residuals is at least 1e-5
trends AS (
    SELECT
        pack, cell, 'trend' AS method, capacity_ah, -slope * capacity_ah / 24 AS current_a,
        sqrt(greatest((total - slope ^ 2 * information) / (n - 2), 1e-10) / information) * capacity_ah / 24 AS std_a
    FROM lines
)
SELECT
    type, pack, cell, method, 1000 * current_a AS self_discharge_ma, 1000 * std_a AS self_discharge_std_ma,
    current_a / std_a AS stds, 2400 * current_a / capacity_ah AS percent_per_day
FROM (SELECT * FROM estimates UNION ALL SELECT * FROM trends) JOIN packs USING (pack)
WHERE current_a > $self_discharge_c * capacity_ah AND current_a > $stds * std_a
QUALIFY row_number() OVER (PARTITION BY pack, cell ORDER BY method) = 1
ORDER BY percent_per_day DESC, pack
