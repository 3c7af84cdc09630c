-- Packs whose capacity or R_s deviates from the packs of their type. Needs: packs, days.
WITH latest AS (
    SELECT pack, arg_max(d, day) AS d FROM days d GROUP BY pack
),
points AS (
    SELECT type, pack, 'capacity_ratio' AS quantity, d.ln_capacity AS value, d.capacity_variance AS variance
    FROM latest JOIN packs USING (pack)
    UNION ALL
    SELECT type, pack, 'r_s_ratio', d.ln_r_s, d.r_s_variance FROM latest JOIN packs USING (pack)
),
-- An imprecise estimate stays near the value of the cell file. Therefore the median of a type is computed from the
-- estimates whose standard deviation is at most twice the lower quartile of the type.
estimates AS (
    SELECT *, variance <= 4 * quantile_cont(variance, 0.25) OVER (PARTITION BY type, quantity) AS is_precise
    FROM points WHERE value IS NOT NULL AND variance > 0
),
middles AS (
    SELECT type, quantity, count(*) AS packs, median(value) AS middle, median(variance) AS median_variance
    FROM estimates WHERE is_precise GROUP BY type, quantity
),
-- The median deviation times 1.4826 is the standard deviation of a normal distribution. It includes the errors of the
-- estimates. Their median variance is subtracted here; the score of a pack adds the variance of its own estimate.
spreads AS (
    SELECT
        type, quantity, any_value(middle) AS middle, any_value(packs) AS packs,
        greatest((1.4826 * median(abs(value - middle))) ^ 2 - any_value(median_variance), $min_spread ^ 2) AS spread_variance
    FROM estimates JOIN middles USING (type, quantity) WHERE is_precise
    GROUP BY type, quantity
)
SELECT
    type, pack, quantity, exp(value) AS value, exp(value) * sqrt(variance) AS value_std, exp(middle) AS median_of_type,
    sqrt(spread_variance) * exp(middle) AS spread_of_type, (value - middle) / sqrt(spread_variance + variance) AS score
FROM estimates JOIN spreads USING (type, quantity)
WHERE packs >= $min_packs AND abs(value - middle) / sqrt(spread_variance + variance) > $stds
ORDER BY abs(score) DESC, pack
