//! Numbers as YAML files hold them.

/// The shortest digits that read back as the same number, in a form that every YAML reader takes for a
/// number: readers of YAML 1.1 need a point in the mantissa.
pub(super) fn number(value: f64) -> String {
    let text = format!("{value:?}");
    match text.split_once('e') {
        Some((mantissa, exponent)) if !mantissa.contains('.') => {
            format!("{mantissa}.0e{exponent}")
        }
        _ => text,
    }
}

/// Numbers in brackets.
pub(super) fn list(values: impl IntoIterator<Item = f64>) -> String {
    let numbers: Vec<String> = values.into_iter().map(number).collect();
    format!("[{}]", numbers.join(", "))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_read_back_and_have_a_point() {
        for value in [1e-7, -2.5e-9, 0.1, 1861.4, 1e22, 0.0] {
            let text = number(value);
            assert!(text.contains('.'), "{text}");
            assert_eq!(text.parse::<f64>().unwrap(), value);
        }
    }
}
