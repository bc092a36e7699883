//! Templates of self-contained pages.

/// Replaces each `{{name}}` of a page by its text. Placeholders in the texts are not replaced.
pub fn filled(page: &str, texts: &[(&str, String)]) -> String {
    let mut parts = page.split("{{");
    let mut page = parts.next().unwrap_or_default().to_owned();
    for part in parts {
        let (place, rest) = part.split_once("}}").unwrap_or_default();
        let text = texts.iter().find(|(name, _)| *name == place).map(|(_, text)| text.as_str());
        page += text.unwrap_or_default();
        page += rest;
    }
    page
}

/// Escapes HTML markup in a text.
pub fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

/// JSON for a script element, which neither `</script>` nor `<!--<script>` in it may end or extend.
pub fn in_script(json: &str) -> String {
    json.replace('<', "\\u003c")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn filled_text_is_not_expanded_or_markup() {
        let page = filled("a {{x}} b {{y}} {{x}}{{z}}.", &[("x", "{{y}}".to_owned()), ("y", "2".to_owned())]);
        assert_eq!(page, "a {{y}} b 2 {{y}}.");
        assert_eq!(escaped("<a & \"b\">"), "&lt;a &amp; &quot;b&quot;&gt;");
        let json = in_script(&serde_json::json!("<!--<script></script>").to_string());
        assert!(!json.contains('<'));
        assert_eq!(serde_json::from_str::<String>(&json).unwrap(), "<!--<script></script>");
    }
}
