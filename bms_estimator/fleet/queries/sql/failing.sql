-- Packs that will soon reach a limit, or have recent input faults. Needs: packs, days, fits.
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
)
SELECT
    type, pack, quantity, value, limit_value AS "limit", per_year, days_left,
    greatest(earliest, 0) AS days_left_low, latest AS days_left_high, stds
FROM (SELECT * FROM trends WHERE stds > $stds AND days_left <= $within_days UNION ALL SELECT * FROM suspected)
JOIN packs USING (pack)
ORDER BY days_left, stds DESC, pack, quantity
