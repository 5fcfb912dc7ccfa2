// What a header has of JSON: objects, arrays, strings and numbers.

#pragma once

#include <algorithm>
#include <cctype>
#include <cmath>
#include <cstdint>
#include <locale>
#include <sstream>
#include <stdexcept>
#include <string>
#include <vector>

namespace hlm {

// What is wrong, in one line, whatever a file has in it.
struct Error : std::runtime_error {
    explicit Error(std::string wrong) : std::runtime_error(one_line(wrong)) {}

private:
    static std::string& one_line(std::string& text) {
        for (char& letter : text)
            if (std::iscntrl(static_cast<unsigned char>(letter))) letter = '?';
        return text;
    }
};

// Refuse what a file says unless it is right.
inline void check(bool is_right, const char* wrong, const std::string& name = "") {
    if (!is_right) throw Error("the file is broken, or no compact map: " + (wrong + name));
}

// A value. A member that is missing, or of another type, is refused.
class Json {
public:
    explicit Json(const std::string& text) {
        const char *at = text.c_str(), *end = at + text.size();  // a 0 is at the end
        parse(at, 0);
        check(*skip_spaces(at) == 0 && at == end, "text behind JSON");
    }

    // Return the member of a name, of several the last one.
    const Json& operator[](const std::string& name) const {
        const auto found = std::find(keys().rbegin(), keys().rend(), name);
        check(found != keys().rend(), "no ", name);
        return items_[static_cast<std::size_t>(keys().rend() - found) - 1];
    }
    const std::vector<std::string>& keys() const { return of('{').keys_; }
    const std::vector<Json>& values() const { return of('{').items_; }
    const std::vector<Json>& array() const { return of('[').items_; }
    const std::string& string() const { return of('"').text_; }
    double number() const { return of('0').number_; }
    std::size_t whole() const {
        check(number() >= 0 && number_ < 0x1p53 && number_ == std::floor(number_), "no size");
        return static_cast<std::size_t>(number_);
    }

private:
    static constexpr int MAX_DEPTH = 64;

    Json() = default;

    const Json& of(char type) const {
        check(type_ == type, "JSON of another type");
        return *this;
    }

    static const char*& skip_spaces(const char*& at) {
        while (*at == ' ' || *at == '\t' || *at == '\r' || *at == '\n') ++at;
        return at;
    }

    void parse(const char*& at, int depth) {
        check(depth < MAX_DEPTH, "JSON that is too deep");
        type_ = *skip_spaces(at);
        if (type_ == '"') {
            text_ = parse_string(at);
        } else if (type_ == '{' || type_ == '[') {
            const char close = type_ == '{' ? '}' : ']';
            ++at;
            if (*skip_spaces(at) == close) return void(++at);
            for (char separator = ','; separator == ','; separator = *at++) {
                if (type_ == '{') {
                    skip_spaces(at);
                    keys_.push_back(parse_string(at));
                    check(*skip_spaces(at) == ':', "JSON without :");
                    ++at;
                }
                items_.push_back(Json());
                items_.back().parse(at, depth + 1);
                check(*skip_spaces(at) == ',' || *at == close, "JSON without a bracket");
            }
        } else {
            std::string word;
            while (std::isalnum(static_cast<unsigned char>(*at)) || *at == '+' || *at == '-' ||
                   *at == '.')
                word += *at++;
            type_ = 'n';
            if (word == "true" || word == "false" || word == "null") return;
            type_ = '0';
            std::istringstream stream(word);
            stream.imbue(std::locale::classic());  // in which 0.5 has a point
            check(stream >> number_ && stream.eof(), "no JSON");
        }
    }

    // Parse a string; in those that are used, no letter beyond ASCII is escaped.
    static std::string parse_string(const char*& at) {
        check(*at++ == '"', "JSON without a string");
        std::string text;
        for (; *at != '"'; ++at) {
            check(*at != 0, "JSON that ends too early");
            if (*at != '\\') {
                text += *at;
                continue;
            }
            static const std::string escapes = "\"\\/bfnrtu", meant = "\"\\/\b\f\n\r\t?";
            const std::size_t which = escapes.find(*++at);
            check(*at != 0 && which != std::string::npos, "JSON with a wrong escape");
            text += meant[which];
        }
        ++at;
        return text;
    }

    char type_ = 'n';  // its first letter, 0 for all numbers, n for those without a value
    double number_ = 0;
    std::string text_;
    std::vector<std::string> keys_;  // of an object, whose items are the values
    std::vector<Json> items_;
};

}  // namespace hlm
