-- One row per day and pack: estimates at the end of the day, and measurements of the day. Relative standard deviations
-- become variances of logarithms.
CREATE TEMP TABLE days AS
SELECT
    pack,
    hour // 24 AS day,
    any_value(cell) AS cell,
    any_value(series) AS series,
    any_value(parallel) AS parallel,
    any_value(capacity_ah) AS capacity_ah,
    max(hour) AS last_hour,
    ln(arg_max(capacity_ratio, hour)) AS ln_capacity,
    arg_max((capacity_ratio_std / capacity_ratio) ^ 2, hour)::DOUBLE AS capacity_variance,
    arg_max(capacity_first_std ^ 2, hour)::DOUBLE AS capacity_first_variance,
    sum((charge_out_ah + charge_in_ah) / capacity_ah) AS through,
    -- Weighted mean of R_s over the hours with a recently identified R_s. The hours of a day are not independent, so the
    -- variance of the mean is that of the most precise hour.
    sum(ln(r_s_ratio) / (r_s_ratio_std / r_s_ratio) ^ 2) FILTER (r_s_unlearned_s < $r_s_fresh_s)
        / sum(1 / (r_s_ratio_std / r_s_ratio) ^ 2) FILTER (r_s_unlearned_s < $r_s_fresh_s) AS ln_r_s,
    min((r_s_ratio_std / r_s_ratio) ^ 2) FILTER (r_s_unlearned_s < $r_s_fresh_s)::DOUBLE AS r_s_variance,
    min(stability_margin_min)::DOUBLE AS margin,
    avg(temperature_c) AS temperature_c,
    sum(samples) AS samples,
    arg_max(suspects, hour) AS suspects,
    arg_max(soc, hour) AS soc,
    arg_max(soc_std, hour) AS soc_std
FROM hours
GROUP BY pack, day
