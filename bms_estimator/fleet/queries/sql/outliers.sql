-- Needs: packs, days.
WITH latest AS (
    SELECT pack, arg_max(d, day) AS d FROM days d GROUP BY pack
),
points AS (
    SELECT type, pack, 'capacity_ratio' AS quantity, d.ln_capacity AS value, d.capacity_variance AS variance
    FROM latest JOIN packs USING (pack)
    UNION ALL
    SELECT type, pack, 'r_s_ratio', d.ln_r_s, d.r_s_variance FROM latest JOIN packs USING (pack)
),
-- An estimate that knows little stays near the cell file: what is usual of a type is said by those that are at most
-- twice as unsure as its surest quarter.
sure AS (
    SELECT *, variance <= 4 * quantile_cont(variance, 0.25) OVER (PARTITION BY type, quantity) AS tells
    FROM points WHERE value IS NOT NULL AND variance > 0
),
middles AS (
    SELECT type, quantity, count(*) AS packs, median(value) AS middle, median(variance) AS usual
    FROM sure WHERE tells GROUP BY type, quantity
),
-- The median deviation holds the packs' own errors, too: they are taken off, and each has its own back in its score.
spreads AS (
    SELECT
        type, quantity, any_value(middle) AS middle, any_value(packs) AS packs,
        greatest((1.4826 * median(abs(value - middle))) ^ 2 - any_value(usual), $least_spread ^ 2) AS apart
    FROM sure JOIN middles USING (type, quantity) WHERE tells
    GROUP BY type, quantity
)
SELECT
    type, pack, quantity, exp(value) AS value, exp(value) * sqrt(variance) AS value_std, exp(middle) AS median_of_type,
    sqrt(apart) * exp(middle) AS spread_of_type, (value - middle) / sqrt(apart + variance) AS score
FROM sure JOIN spreads USING (type, quantity)
WHERE packs >= $least_packs AND abs(value - middle) / sqrt(apart + variance) > $stds
ORDER BY abs(score) DESC, pack
