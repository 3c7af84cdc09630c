-- Comparison of the SOC at the end of an hour with a reference: a later, more precise estimate, brought back by the charge
-- counted in between. For an optimal filter, the variance of their difference is P1 + Q - P2. P1 is the variance of the
-- estimate, Q that of the counted charge, and P2 that of the later estimate, brought back. Needs: hours, packs.
WITH chosen AS (
    SELECT pack FROM packs ORDER BY hash(pack) LIMIT $max_packs
),
-- s_l, s_o: covariances of SOC with ln(capacity) and with the current offset, divided by the standard deviation of the
-- latter; l_o: correlation of ln(capacity) and current offset
rows AS (
    SELECT
        pack, hour, soc, soc_mean_std ^ 2 AS variance, ln(capacity_ratio) AS ln_q,
        capacity_ah * capacity_ratio AS capacity_ah, capacity_ratio_std / capacity_ratio AS ln_q_std,
        current_offset_a AS offset_a, current_offset_std_a AS offset_std_a, temperature_c,
        soc_mean_std * soc_capacity_correlation AS s_l, soc_mean_std * soc_offset_correlation AS s_o,
        capacity_offset_correlation AS l_o,
        sum(charge_out_ah - charge_in_ah) OVER w AS charge_ah,
        sum(charge_out_ah + charge_in_ah) OVER w AS through_ah,
        sum(seen_s) OVER w AS seen_s,
        sum(CASE WHEN gaps > 0 OR lost_blocks > 0 OR dropped > 0.01 * samples THEN 1 ELSE 0 END) OVER w AS gap_count,
        sum(searches) OVER w AS searches
    FROM hours JOIN chosen USING (pack)
    WHERE soc_mean_std > 0
    WINDOW w AS (PARTITION BY pack ORDER BY hour)
),
-- a: an hour; b: a later hour, without a gap in between
pairs AS (
    SELECT
        a.pack, a.hour, a.soc, a.variance, a.temperature_c,
        b.capacity_ah, b.ln_q_std, b.offset_std_a,
        (b.seen_s - a.seen_s) / 3600 / b.capacity_ah AS per_a,  -- SOC that a current of 1 A draws in this time
        (b.charge_ah - a.charge_ah - b.offset_a * (b.seen_s - a.seen_s) / 3600) / b.capacity_ah AS soc_change,
        $charge_error ^ 2 * (b.through_ah - a.through_ah) / b.capacity_ah AS noise,
        b.soc + soc_change AS hindsight,
        b.variance + (per_a * b.offset_std_a) ^ 2 + (soc_change * b.ln_q_std) ^ 2
            - 2 * per_a * b.offset_std_a * b.s_o - 2 * soc_change * b.ln_q_std * b.s_l
            + 2 * per_a * soc_change * b.offset_std_a * b.ln_q_std * b.l_o AS projected_variance
    FROM rows a CROSS JOIN (VALUES (1), (3), (6), (12), (24)) AS later(hours)
    JOIN rows b ON b.pack = a.pack AND b.hour = a.hour + later.hours
    WHERE a.gap_count = b.gap_count AND b.seen_s - a.seen_s > $min_seen_s * (b.hour - a.hour)
),
-- The most precise of the later estimates, if it is much more precise than the estimate. Otherwise the comparison would
-- test the counted charge and not the filter.
most_precise AS (
    SELECT pack, hour, arg_min(p, projected_variance + noise) AS p FROM pairs p GROUP BY pack, hour
    HAVING min(projected_variance + noise) < $max_variance_ratio * any_value(variance)
),
judged AS (
    SELECT
        pack, type, p.temperature_c AS temperature_c, hour - 24 * first_day AS age_h,
        abs(p.soc - p.hindsight) / sqrt(p.variance + p.noise - p.projected_variance) AS stds
    FROM most_precise JOIN packs USING (pack)
),
groups AS (
    SELECT 1 AS place, 'all' AS of, '' AS which, * FROM judged
    UNION ALL
    SELECT 2, 'type', type, * FROM judged
    UNION ALL
    SELECT 3, 'temperature', format('{:d} to {:d} C', 10 * floor(temperature_c / 10)::INT, 10 * floor(temperature_c / 10)::INT + 10), *
    FROM judged WHERE temperature_c IS NOT NULL
    UNION ALL
    SELECT 4, 'age', CASE WHEN age_h < 24 THEN 'first day' WHEN age_h < 168 THEN 'first week' ELSE 'later' END, * FROM judged
),
-- The errors of one pack's hours are correlated, while packs are independent (ratio estimator over clusters)
clusters AS (
    SELECT place, of, which, pack, count(*) AS n, sum(CASE WHEN stds <= 2 THEN 1 ELSE 0 END) AS within
    FROM groups GROUP BY place, of, which, pack
),
shares AS (
    SELECT place, of, which, count(*) AS packs, sum(n) AS judgements, sum(within) / sum(n) AS share FROM clusters
    GROUP BY place, of, which
),
effective AS (
    SELECT
        place, of, which, any_value(s.packs) AS packs, any_value(s.judgements) AS judgements, any_value(s.share) AS share,
        -- effective number of independent comparisons, from the variance between packs; without such a variance, one per
        -- pack
        CASE WHEN sum((within - share * n) ^ 2) > 0 AND any_value(s.packs) > 1
            THEN least(
                any_value(share * (1 - share)) * sum(n) ^ 2 * (1 - 1 / any_value(s.packs)) / sum((within - share * n) ^ 2), sum(n)
            )
            ELSE any_value(s.packs) END AS m
    FROM clusters JOIN shares s USING (place, of, which) GROUP BY place, of, which
),
-- 95.45 % of a normal distribution is within 2 standard deviations
factors AS (
    SELECT place, of, which, quantile_cont(stds, 0.9545) / 2 AS factor FROM groups GROUP BY place, of, which
)
-- Wilson's 95 % score interval of the fraction: z = 1.96, z^2 = 3.8416, z^2 / 2 = 1.9208, z^2 / 4 = 0.9604
SELECT
    of, which, packs, judgements, share AS within_2_std,
    (share + 1.9208 / m - 1.96 * sqrt(share * (1 - share) / m + 0.9604 / m ^ 2)) / (1 + 3.8416 / m) AS low,
    (share + 1.9208 / m + 1.96 * sqrt(share * (1 - share) / m + 0.9604 / m ^ 2)) / (1 + 3.8416 / m) AS high,
    factor AS std_should_be_times
FROM effective JOIN factors USING (place, of, which)
ORDER BY place, which
